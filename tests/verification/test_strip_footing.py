# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bearing capacity of a strip footing on clay and frictional soil, after Prandtl and Martin."""

from mpi4py import MPI

import numpy as np
import pytest

import demos.verification.strip_footing as demo
import fenicsx_hmcontact as hm
from fenicsx_hmcontact._compat import cell_nodes
from meshes.strip_footing import strip_footing

PRANDTL = 2.0 + np.pi
BALANCED = 1e-7
"""Sum of forces over the load."""

STIFF = ["--nu", "0.4999", "--tolerance", "1e-9"]
"""Increments count by their stiffness, which is here that of volume: forces need a digit more."""


def footing(*words, comm=MPI.COMM_WORLD):
    """Footing of the demo with given words on its command line, pushed down."""
    options, _ = demo.parse(["--quick", *words])
    model = demo.Footing(options, comm)
    model.push()
    return model


def figures(*words):
    return footing(*words).figures()


# --- theory and mesh -----------------------------------------------------------------------------


def test_factors_and_mechanism():
    assert demo.factors(0.0) == (PRANDTL, 1.0)
    assert demo.factors(1e-4) == pytest.approx((PRANDTL, 1.0), rel=1e-5)
    assert demo.factors(25.0) == pytest.approx((20.72, 10.66), rel=5e-4)
    assert demo.factors(30.0) == pytest.approx((30.14, 18.40), rel=5e-4)
    assert demo.mechanism(0.0) == pytest.approx((3.0, np.sqrt(2.0)))


@pytest.mark.mpi
@pytest.mark.parametrize(("h", "growth"), [(0.5, 0.0), (0.3, 0.2)])
def test_mesh_has_a_node_at_the_edge(comm, h, growth):
    domain = strip_footing(comm, h=h, growth=growth, width=4.0, depth=3.0)
    x, cells = domain.mesh.geometry.x, cell_nodes(domain.mesh)[domain.cells("ground")]
    a, b = (x[cells[:, i], :2] - x[cells[:, 0], :2] for i in (1, 2))
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    assert comm.allreduce(area) == pytest.approx(12.0, rel=1e-13)
    distance = np.abs(x[:, :2] - [1.0, 0.0]).sum(axis=1).min()
    assert comm.allreduce(distance, MPI.MIN) == 0.0
    assert set(domain.surfaces) == {"base", "surface", "axis", "bottom", "side"}


def test_mesh_refuses_what_makes_no_sense(comm):
    for name, value in (("h", 0.0), ("depth", -1.0), ("growth", -0.1), ("width", 1.0)):
        with pytest.raises(ValueError, match="half_width" if name == "width" else name):
            strip_footing(comm, **{name: value})


@pytest.mark.parametrize(
    "words", [["--h", "0"], ["--steps", "0"], ["--weight", "-1"], ["--psi", "5"], ["--c", "0"]]
)
def test_refused_options(comm, words, capsys):
    with pytest.raises(SystemExit):
        demo.parse(words)
    # One rank speaks for all.
    assert (words[0] in capsys.readouterr().err) == (comm.rank == 0)


# --- clay ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [[], ["--undrained"], ["--smooth-base"], STIFF])
def test_clay_does_not_lock(words):
    found = figures(*words)
    assert 4.75 < found["q_over_c_corrected"] < PRANDTL
    assert PRANDTL < found["q_over_c"] < 6.3
    assert 0.0 <= found["plateau_slope"] < 0.35
    assert found["newton_mean"] <= 4.0 and found["failed_steps"] == 0
    assert found["imbalance"] < BALANCED


def test_full_enhancement_and_linear_triangles_lock():
    """What the deviatoric enhancement is there for: loads that rise on and on."""
    for kind, least in (("full", 6.5), ("triangles", 9.0)):
        found = figures("--smoothing", kind)
        assert found["q_over_c"] > least and found["plateau_slope"] > 1.0


@pytest.mark.mpi
@pytest.mark.parametrize("words", [[], ["--undrained"], ["--smoothing", "triangles"]])
def test_any_number_of_ranks_gives_the_same(words):
    together, alone = (
        footing("--steps", "8", *words, comm=comm) for comm in (MPI.COMM_WORLD, MPI.COMM_SELF)
    )
    loads = [model.history["q_over_c"] for model in (together, alone)]
    assert loads[0] == pytest.approx(loads[1], rel=1e-9)
    assert [s.iterations for s in together.steps] == [s.iterations for s in alone.steps]
    strains = []
    for model in (together, alone):
        field = model.plastic_strain()
        owned = field.function_space.dofmap.index_map.size_local
        strains.append(model.problem.comm.allreduce(field.x.array[:owned].sum()))
    assert strains[0] == pytest.approx(strains[1], rel=1e-8)


def test_units_do_not_matter():
    """Another force, and 1/1024 m: by a power of two gmsh draws the same mesh."""
    ours = footing("--steps", "8")
    other = footing(*"--steps 8 --E 1 --c 0.01 --half-width 1024 --settlement 307.2".split())
    assert other.history["q_over_c"] == pytest.approx(ours.history["q_over_c"], rel=1e-12)
    assert [s.iterations for s in other.steps] == [s.iterations for s in ours.steps]


def test_a_step_out_of_balance_is_refused():
    options, _ = demo.parse(["--quick", "--steps", "3"])
    model = demo.Footing(options)
    model.push()
    model.check()
    model.problem._condensed[model.base[:1]] *= 2.0
    with pytest.raises(hm.StepRejected, match="out of balance"):
        model.check()


@pytest.mark.slow
@pytest.mark.parametrize("nu", [0.3, 0.49, 0.4999])
def test_load_converges_to_prandtl(nu):
    settlement = ["--settlement", "1.5", "--steps", "60"] if nu == 0.3 else []
    loads = []
    for h in (0.25, 0.125):
        options, _ = demo.parse(["--h", str(h), "--nu", str(nu), *settlement])
        model = demo.Footing(options)
        model.push()
        found = model.figures()
        assert 5.04 < found["q_over_c_corrected"] < 5.25 and abs(found["plateau_slope"]) < 0.3
        assert found["newton_mean"] <= 4.0
        loads.append(found["q_over_c"])
    assert abs(2.0 * loads[1] - loads[0] - PRANDTL) < 0.1


@pytest.mark.slow
def test_undrained_clay_at_the_default_mesh():
    options, _ = demo.parse(["--undrained"])
    model = demo.Footing(options)
    model.push()
    assert 4.9 < model.figures()["q_over_c_corrected"] < 5.3


# --- frictional soil -----------------------------------------------------------------------------

SAND = ["--phi", "25", "--E", "1e7", "--smoothing", "quadratic"]


@pytest.mark.parametrize(("words", "exact"), [([], 20.72), (["--surcharge", "1e4"], 31.38)])
def test_cohesion_and_surcharge(words, exact):
    found = figures(*SAND, *words)
    assert found["q_over_c_exact"] == pytest.approx(exact, rel=5e-4)
    assert found["q_over_c_corrected"] == pytest.approx(exact, rel=0.05)
    assert abs(found["plateau_slope"]) < 0.1 * exact and found["imbalance"] < BALANCED


def test_ground_at_rest_stays_so():
    """Weight is in equilibrium with the stress at rest: only the base moves anything."""
    for kind in ("deviatoric", "quadratic"):
        words = ["--quick", "--phi", "25", "--weight", "2e4", "--E", "1e7", "--smoothing", kind]
        options, _ = demo.parse([*words, "--surcharge", "1e4"])
        model = demo.Footing(options)
        model.settlement.value = (0.0, 0.0)
        assert model.problem.solve().iterations == 1
        assert np.abs(model.u.x.array).max() < 1e-12
        assert model.load() == pytest.approx(1e4, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("words", "exact"), [([], 6.491), (["--smooth-base"], 3.461)])
def test_weight(words, exact):
    mesh = ["--h", "0.0625", "--growth", "0.05", "--settlement", "0.2"]
    options, _ = demo.parse([*SAND, *mesh, "--c", "20", "--weight", "2e4", *words])
    model = demo.Footing(options)
    model.push()
    found = model.figures()
    assert found["N_gamma_exact"] == exact
    assert found["N_gamma_corrected"] == pytest.approx(exact, rel=0.05)
