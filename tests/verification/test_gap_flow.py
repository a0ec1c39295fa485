# SPDX-License-Identifier: LGPL-3.0-or-later
"""Water in a gap of given aperture against flow between plates and resistances in series."""

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from tests.models import GAMMA, LOAD, Porous, integral, largest, stack, total

pytestmark = pytest.mark.mpi

MESHES = [(6, 6), (5, 7), (11, 3)]
BASE = {("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0}
STIFF = hm.LinearElastic(1e10, 0.2)


@pytest.mark.parametrize("across", MESHES)
@pytest.mark.parametrize("order", [("bottom_1", "top_0"), ("top_0", "bottom_1")])
@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
def test_channel_between_nearly_impermeable_blocks(comm, across, order, smoothing):
    g, mu, width, drop, dt = 1e-3, 1e-3, 0.5, 1e3, 1e6
    model = Porous(
        stack(comm, across, width=width),
        fixed=BASE,
        drained={f"{side}_{k}": p for side, p in (("left", drop), ("right", 0.0)) for k in (0, 1)},
        pairs=[(*order, hm.GapFlow(1e-7, mu, aperture=g))],
        material=STIFF,
        permeability=1e-14,
        smoothing=smoothing,
        dt=dt,
    )
    for _ in range(3):
        # The reservoirs' pressures reach the film in the first iteration.
        assert model.step().iterations == 1
    flow = g**3 * drop / (12 * mu * width)
    entering = total(model.problem.reactions(model.p), model.domain)
    assert abs(entering[0]) < 1e-8 * flow * dt
    for side, sign in (("left", 1), ("right", -1)):
        through = sum(
            total(model.problem.reactions(model.p), model.domain, f"{side}_{k}")[0] for k in (0, 1)
        )
        assert sign * through / dt == pytest.approx(flow, rel=1e-8)
    state = model.problem.interface(model.pairs[0])
    expected = drop * (1 - state.points[:, 0] / width)
    assert np.abs(state.pore_pressure - expected).max() < 1e-8 * drop


def layered(domain, values):
    """Permeability of each block."""
    k = fem.Function(fem.functionspace(domain.mesh, ("DG", 0)))
    for tag, value in enumerate(values, start=1):
        k.x.array[domain.cell_tags.find(tag)] = value
    return k


@pytest.mark.parametrize("across", MESHES[:2])
@pytest.mark.parametrize(("g", "k_t"), [(1e-2, 1e-8), (1e-3, 1e-7), (1e-3, 1e-10), (1e-14, 1e-7)])
@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
def test_leak_off_is_a_resistance_in_series(comm, across, g, k_t, smoothing):
    domain = stack(comm, across, width=0.5)
    k, drop, dt = (1e-6, 2e-6), 1e4, 1e6
    model = Porous(
        domain,
        fixed=BASE,
        drained={"bottom_0": drop, "top_1": 0.0},
        pairs=[("bottom_1", "top_0", hm.GapFlow(k_t, aperture=g))],
        permeability=layered(domain, k),
        smoothing=smoothing,
        dt=dt,
    )
    for _ in range(3):
        model.step()
    q = drop / GAMMA / (0.5 / k[0] + g / k_t + 0.5 / k[1])
    for surface, sign in (("bottom_0", -1), ("top_1", 1)):
        assert sign * model.outflow(surface) / dt / 0.5 == pytest.approx(q, rel=1e-6)
    state = model.problem.interface(model.pairs[0])
    # Water goes up, to the secondary side, where the pressure is lower.
    fall = q * GAMMA * g / k_t
    assert np.abs(state.jump + fall).max() < 1e-6 * max(fall, 1e-3 * drop)
    middle = drop - q * GAMMA * 0.5 / k[0] - fall / 2
    assert np.abs(state.pore_pressure - middle).max() < 1e-6 * drop


def test_tiny_apertures_are_closed(comm):
    pressures = []
    for aperture in (None, 0.0, 1e-16, 1e-12):
        model = Porous(
            stack(comm, (5, 8), slope=0.1),
            fixed=BASE,
            drained={"top_1": 0.0},
            tractions={"top_1": (0.0, -LOAD)},
            pairs=[("bottom_1", "top_0", hm.GapFlow(1e-9, aperture=aperture))],
        )
        for dt in (10.0, 10.0, 100.0, 1000.0):
            model.step(dt)
        pressures.append(model.p.x.array.copy())
        state = model.problem.interface(model.pairs[0])
        assert np.abs(state.jump).max() < 1e-2 * LOAD
    assert largest(pressures[0], comm) > 0.5 * LOAD
    np.testing.assert_array_equal(pressures[0], pressures[1])
    for p in pressures[2:]:
        assert largest(p - pressures[0], comm) < 1e-9 * LOAD


def test_a_film_of_little_permeability_holds_water_back(comm):
    # What the sealed lower block loses has crossed the film, at the rate of its pressure's jump.
    g, k_t = 1e-4, 1e-14
    model = Porous(
        stack(comm, (5, 8), slope=0.1),
        fixed=BASE | {(f"{s}_{k}", 0): 0.0 for s in ("left", "right") for k in (0, 1)},
        drained={"top_1": 0.0},
        tractions={"top_1": (0.0, -LOAD)},
        pairs=[("bottom_1", "top_0", hm.GapFlow(k_t, aperture=g))],
    )
    for dt in (10.0, 100.0, 1e4, 1e5):
        before = volume_of_lower(model)
        model.step(dt)
        lost = before - volume_of_lower(model)
        state = model.problem.interface(model.pairs[0])
        order = np.argsort(state.points[:, 0])
        length = np.linalg.norm(np.diff(state.points[order], axis=0), axis=1)
        jump = state.jump[order]
        leaked = -dt * k_t / (GAMMA * g) * np.sum(length * (jump[1:] + jump[:-1]) / 2)
        assert leaked == pytest.approx(lost, rel=1e-8)
    assert leaked > 0 and np.abs(jump).min() > 0.5 * LOAD


def volume_of_lower(model):
    """Volume by which the lower block has grown."""
    dx = ufl.Measure("dx", domain=model.domain.mesh, subdomain_data=model.domain.cell_tags)
    form = fem.form(ufl.div(model.u) * dx(model.domain.body("block_0")))
    return integral(form, model.domain.mesh.comm)
