# SPDX-License-Identifier: LGPL-3.0-or-later
"""Consolidation across a tied interface: as if there were none."""

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import surface_values
from fenicsx_hmcontact.poromechanics.analytic import terzaghi_degree, terzaghi_pressure
from tests.models import GAMMA, LOAD, K, Porous, integral, largest, stack, total

CLOSED = [("bottom_1", "top_0", hm.GapFlow(1e-9))]
SKELETON = hm.LinearElastic(1e8, 0.0)


def column(comm, across, rows, *, pairs=CLOSED, k_x=K, slope=0.0, **options):
    """Terzaghi's column of one or two blocks, 0.5 m by 1 m, on rollers."""
    n = len(across)
    top = f"top_{n - 1}"
    fixed = {("bottom_0", 1): 0.0}
    fixed |= {(f"{side}_{k}", 0): 0.0 for side in ("left", "right") for k in range(n)}
    return Porous(
        stack(comm, across, width=0.5, rows=rows, slope=slope),
        fixed=fixed,
        drained={top: 0.0},
        tractions={top: (0.0, -LOAD)},
        pairs=pairs if n == 2 else (),
        material=SKELETON,
        permeability=np.diag([k_x, K]),
        **options,
    )


def errors(model, t):
    """Area-weighted rms and largest nodal error of p / load."""
    exact = fem.Function(model.Q)
    exact.interpolate(lambda x: terzaghi_pressure(x[1], t, 1.0, 1e-5, LOAD))
    comm = model.domain.mesh.comm
    square = integral(fem.form((model.p - exact) ** 2 * ufl.dx), comm)
    return np.sqrt(square / 0.5) / LOAD, largest(model.p.x.array - exact.x.array, comm) / LOAD


def jump(model):
    """Largest difference of the two faces' pressures at a node of either / load."""
    faces = []
    for name in ("top_0", "bottom_1"):
        points, values = surface_values(
            model.p, model.domain.facet_tags, model.domain.surface(name)
        )
        order = np.argsort(points[:, 0])
        faces.append((points[order, 0], values[order, 0]))
    x = np.union1d(faces[0][0], faces[1][0])
    return np.abs(np.interp(x, *faces[0]) - np.interp(x, *faces[1])).max() / LOAD


@pytest.mark.parametrize("k_x", [K, 1.0], ids=["isotropic", "as in the paper"])
def test_two_blocks_are_as_good_as_one(comm, k_x):
    # The cells of the drained block decide: the single column has as many across.
    two, one = (column(comm, a, r, k_x=k_x) for a, r in (((20, 32), 20), ((32,), 40)))
    t = 0.0
    # Backward Euler's share of the errors with these steps is 6.7e-3, 2.5e-3 and 1.2e-3; the rest
    # sits under the drained top, more of it where water does not level out across.
    first = 1e-2 if k_x == 1.0 else 2e-2
    for count, dt, bound in ((20, 5.0, first), (45, 20.0, 3e-3), (90, 100.0, 1.5e-3)):
        t += count * dt
        for model in (two, one):
            for _ in range(count):
                model.step(dt)
        ratios = [a / b for a, b in zip(errors(two, t), errors(one, t), strict=True)]
        assert max(ratios) <= 1.05
        assert errors(two, t)[1] < bound
        assert k_x == K or jump(two) < 1e-9
    assert two.problem.n_factorisations == 3


@pytest.mark.mpi
@pytest.mark.parametrize("smoothing", ["deviatoric", "full", "triangles"])
def test_pressure_is_continuous_with_the_permeability_of_the_paper(comm, smoothing):
    # Water levels out across at once, so that both faces have one pressure along their length.
    model = column(comm, (5, 8), 10, k_x=1.0, smoothing=smoothing)
    for dt in (5.0, 20.0, 100.0, 1000.0, 5000.0):
        model.step(dt)
        assert jump(model) < 1e-9


@pytest.mark.mpi
@pytest.mark.parametrize("secondary", [("bottom_1", "top_0"), ("top_0", "bottom_1")])
@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_settlement_follows_the_series(comm, slope, secondary):
    model = column(comm, (8, 12), 10, slope=slope, pairs=[(*secondary, CLOSED[0][2])])
    for dt in 10 * [10.0] + 18 * [50.0]:
        model.step(dt)
    ds = ufl.Measure("ds", domain=model.domain.mesh, subdomain_data=model.domain.facet_tags)
    form = fem.form(model.u[1] * ds(model.domain.surface("top_1")))
    degree = -integral(form, comm) / 0.5 * SKELETON.E / LOAD
    assert degree == pytest.approx(float(terzaghi_degree(1000.0, 1.0, 1e-5)), abs=1.5e-3)
    assert errors(model, 1000.0)[1] < 1.2e-2


@pytest.mark.mpi
@pytest.mark.parametrize("smoothing", ["deviatoric", "full", "triangles"])
@pytest.mark.parametrize("secondary", [("bottom_1", "top_0"), ("top_0", "bottom_1")])
def test_hydrostatic_state_stays_across_an_inclined_interface(comm, smoothing, secondary):
    weight = 2e4
    model = Porous(
        stack(comm, (7, 4), slope=0.3),
        fixed={("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0},
        drained={"top_1": 0.0},
        pairs=[(*secondary, hm.GapFlow(1e-9))],
        weight=weight,
        smoothing=smoothing,
    )
    for _ in range(4):
        model.step(1e12)
    exact = fem.Function(model.Q)
    exact.interpolate(lambda x: GAMMA * (1 - x[1]))
    assert largest(model.p.x.array - exact.x.array, comm) < 1e-8 * GAMMA
    before = model.u.x.array.copy()
    dx = ufl.Measure("dx", domain=model.domain.mesh, subdomain_data=model.domain.cell_tags)
    grown = [fem.form(ufl.div(model.u - model.u_n) * dx(tag)) for tag in (1, 2)]
    model.step(1e3)
    assert largest(model.u.x.array - before, comm) < 1e-10 * largest(before, comm)
    # What a block gains in volume has come through the interface or the top.
    for form in grown:
        assert abs(integral(form, comm)) < 1e-8 * K * 1e3
    assert abs(model.outflow()) < 1e-8 * K * 1e3
    assert total(model.problem.reactions(model.u), model.domain)[1] == pytest.approx(
        weight, rel=1e-12
    )
