# SPDX-License-Identifier: LGPL-3.0-or-later
"""The void between two surfaces: volumes, what they grow by, forces, and their derivatives."""

import numpy as np
import pytest

from fenicsx_hmcontact._kernels.strips import strip_moments
from fenicsx_hmcontact.contact import MortarOptions, Surface, mortar_operator, mortar_segments
from fenicsx_hmcontact.contact.linearisation import geometry_derivatives
from fenicsx_hmcontact.contact.void import Void

OPTIONS = {
    "in sight": MortarOptions(),
    "flanks out of sight": MortarOptions(largest_angle=30.0),
    "middle out of sight": MortarOptions(search_radius=1.2),
}


def chain(name, points, first, tips=None):
    """A surface of one chain; tips are the numbers of its end nodes if the other has them too."""
    nodes = np.arange(len(points)) + first
    if tips is not None:
        nodes[0], nodes[-1] = tips
    at = np.arange(len(points), dtype=np.int32)
    return Surface(name, nodes, nodes, points, np.column_stack([at[:-1], at[1:]]))


def area(points):
    """Area of a polygon, positive anticlockwise."""
    x, y = points.T
    return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))


def lens(rng, noise=0.01):
    """Faces of a lens-shaped cavity that meet at its tips: the upper and the lower."""
    t = np.linspace(-1.0, 1.0, 9)
    upper = np.column_stack([t, 0.3 * (1.0 - t**2)])
    t = np.linspace(1.0, -1.0, 8)
    lower = np.column_stack([t, -0.25 * (1.0 - t**2)])
    for face in (upper, lower):
        face[1:-1] += rng.normal(size=(len(face) - 2, 2)) * noise
    return upper, lower


def notch(rng, noise=0.005):
    """A wall and a floor, and a block with a base and a side that has risen from them."""
    wall = np.column_stack([np.full(5, 1.0), np.linspace(1.0, 0.0, 5)])
    floor = np.column_stack([np.linspace(1.0, 0.0, 7)[1:], np.zeros(6)])
    base = np.column_stack([np.linspace(0.0, 0.95, 6), np.full(6, 0.33)])
    side = np.column_stack([np.full(4, 0.99), np.linspace(0.37, 1.2, 4)])
    soil, block = np.vstack([wall, floor]), np.vstack([base, side])
    return soil + rng.normal(size=soil.shape) * noise, block + rng.normal(size=block.shape) * noise


class Gap:
    """Two surfaces in their state before and some state now."""

    def __init__(self, secondary, primary, rng, options, *, shared=False, held=(), pools=True):
        self.before = [p + rng.normal(size=p.shape) * 0.01 for p in (secondary, primary)]
        self.n, self.options, self.shared = len(secondary), options, shared
        self.opening = np.linspace(0.1, 0.3, self.n) if pools else None
        if shared:
            self.before[1][[0, -1]] = self.before[0][[-1, 0]]
        self.held = np.isin(np.arange(self.n), held)

    def surfaces(self, secondary, primary):
        tips = (100, 100 + self.n - 1) if self.shared else None
        return chain("s", secondary, 100, tips), chain("p", primary, 300, tips and tips[::-1])

    def void(self, x, before=None):
        now = self.surfaces(x[: 2 * self.n].reshape(-1, 2), x[2 * self.n :].reshape(-1, 2))
        segments = mortar_segments(*now, self.options)
        coupling, water = (
            mortar_operator(*now, segments, held, self.options) for held in (self.held, None)
        )
        d = geometry_derivatives(*now, segments, coupling)
        before = self.surfaces(*(self.before if before is None else before))
        return Void(now, before, segments, coupling, water.kept, self.opening, d)


def test_a_strip_is_integrated_exactly():
    """Against quadrature of x(t) - y(t) swept between two lines."""
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(1, 3, 2, 2)) * 0.1
    corners[0, 0] += [[0.0, 1.0], [1.0, 1.0]]
    corners[0, 1] += [0.0, 1.0]
    corners[0, 2] += [[1.2, 0.0], [-0.2, 0.0]]
    ends, centre = np.array([[-0.7, 0.8]]), np.array([0.1])
    fixed = np.zeros((1, 2), bool)
    before = corners[:, ::2]
    values = strip_moments(corners, before, np.zeros((1, 2, 2)), ends, fixed, fixed, centre, 0)[0]
    x, normals, y = corners[0]
    at = [0.5 * ((1.0 - s) * x[0] + (1.0 + s) * x[1]) for s in ends[0]]
    along = [0.5 * ((1.0 - s) * normals[0] + (1.0 + s) * normals[1]) for s in ends[0]]
    # Where the normals meet the line of the primary edge
    faced = [
        point - np.linalg.solve(np.column_stack([n, y[1] - y[0]]), point - y[0])[0] * n
        for point, n in zip(at, along, strict=True)
    ]
    t, weight = np.polynomial.legendre.leggauss(20)
    t, weight = (t + 1.0) / 2.0, weight / 2.0
    line = at[0] - faced[0] + t[:, None] * (at[1] - faced[1] - at[0] + faced[0])
    motion = 0.5 * (at[1] - at[0] + faced[1] - faced[0])
    swept = motion[0] * line[:, 1] - motion[1] * line[:, 0]
    xi = ends[0, 0] + t * (ends[0, 1] - ends[0, 0])
    assert values[0, 0] == pytest.approx([weight @ swept, weight @ (swept * (xi - 0.1))], rel=1e-13)
    assert np.array_equal(values[0, 0], values[0, 1])
    assert area(np.array([*at, *faced[::-1]])) == pytest.approx(-values[0, 0, 0], rel=1e-13)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_volumes_add_up_to_the_void_and_its_growth(options):
    rng = np.random.default_rng(1)
    upper, lower = lens(rng)
    gap = Gap(upper, lower, rng, options, shared=True)
    void = gap.void(np.concatenate([upper, lower]).ravel())
    now, before = (-area(np.vstack([a, b[1:-1]])) for a, b in ((upper, lower), gap.before))
    assert void.volumes.sum() == pytest.approx(now, rel=1e-13)
    assert void.growth.sum() == pytest.approx(now - before, abs=1e-13)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_uniform_water_presses_on_each_face_as_on_its_chord(options):
    rng = np.random.default_rng(2)
    upper, lower = lens(rng)
    gap = Gap(upper, lower, rng, options, shared=True)
    points = np.concatenate([upper, lower])
    forces = 3.0 * gap.void(points.ravel()).pressing.sum(axis=0).reshape(-1, 2)
    assert forces.sum(axis=0) == pytest.approx([0.0, 0.0], abs=1e-13)
    moment = points[:, 0] * forces[:, 1] - points[:, 1] * forces[:, 0]
    assert moment.sum() == pytest.approx(0.0, abs=1e-13)
    # Each edge pushes both its nodes outwards; at the tips both faces do.
    loop = np.vstack([upper, lower[1:-1]])
    sides = np.roll(loop, -1, axis=0) - loop
    push = 1.5 * np.column_stack([-sides[:, 1], sides[:, 0]])
    of_nodes = np.delete(forces, [9, 16], axis=0)
    of_nodes[[8, 0]] += forces[[9, 16]]
    assert of_nodes == pytest.approx(push + np.roll(push, 1, axis=0), abs=1e-13)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_any_water_in_a_closed_void_leaves_no_force_and_no_moment(options):
    rng = np.random.default_rng(6)
    upper, lower = lens(rng)
    points = np.concatenate([upper, lower])
    void = Gap(upper, lower, rng, options, shared=True).void(points.ravel())
    forces = (void.pressing.T @ rng.normal(size=9)).reshape(-1, 2)
    assert np.abs(forces).max() > 0.1 and not void.mouths
    assert forces.sum(axis=0) == pytest.approx([0.0, 0.0], abs=1e-14)
    moment = points[:, 0] * forces[:, 1] - points[:, 1] * forces[:, 0]
    assert moment.sum() == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize("pools", [True, False])
@pytest.mark.parametrize("held", [(), (0, 10)])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_derivatives_beside_a_notch(options, held, pools):
    rng = np.random.default_rng(3)
    soil, block = notch(rng)
    gap = Gap(soil, block, rng, options, held=held, pools=pools)
    check_derivatives(gap, np.concatenate([soil, block]).ravel(), rng)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_derivatives_in_a_cavity(options):
    rng = np.random.default_rng(4)
    upper, lower = lens(rng)
    gap = Gap(upper, lower, rng, options, shared=True)
    check_derivatives(gap, np.concatenate([upper, lower]).ravel(), rng)


def check_derivatives(gap, x, rng):
    """Compare growth and forces with differences; those of given facing points as well."""
    void, p, n = gap.void(x), rng.normal(size=gap.n), gap.n
    of_growth, of_forces = void.growth_derivative(), void.force_derivative(p)
    for _ in range(4):
        way = rng.normal(size=x.size).reshape(-1, 2)
        if gap.shared:
            way[n], way[-1] = way[n - 1], way[0]
        way, h = way.ravel(), 1e-6
        ahead, behind = (gap.void(x + s * h * way) for s in (1.0, -1.0))
        growth = (ahead.growth - behind.growth) / (2.0 * h)
        assert of_growth @ way == pytest.approx(growth, rel=1e-6, abs=1e-6)
        forces = (ahead.pressing - behind.pressing).T @ p / (2.0 * h)
        assert of_forces @ way == pytest.approx(forces, rel=1e-6, abs=1e-5)
    # Where nothing moves but the state before, the same points face each other.
    back = [part.reshape(-1, 2) for part in np.split(x - 1e-7 * way, [2 * n])]
    small = gap.void(x, before=back)
    assert small.growth == pytest.approx(1e-7 * (void.of_points @ way), abs=1e-12)


def flat(x, y):
    return np.column_stack([x, np.full(len(x), y)])


def test_sliding_over_many_facets_takes_no_water():
    options = MortarOptions()
    upper, lower = np.linspace(0.0, 1.0, 6), np.linspace(5.0, -4.0, 31)
    points = [flat(upper, 0.1), flat(lower, 0.0)]
    gap = Gap(*points, np.random.default_rng(0), options)
    for slip in (0.01, 0.37, 2.5):
        before = [flat(upper - slip, 0.1), flat(lower, 0.0)]
        void = gap.void(np.concatenate(points).ravel(), before=before)
        assert void.growth == pytest.approx(np.zeros(6), abs=1e-15)
        assert void.volumes.sum() == pytest.approx(0.1, rel=1e-13)


def test_a_node_that_touches_has_no_water():
    """Its facets may bridge hollows of the other face; the weighted gap is zero, and so is this."""
    options = MortarOptions()
    lower = flat(np.linspace(1.4, -0.4, 10), 0.0)
    upper = flat(np.linspace(0.0, 1.0, 6), 0.0)
    upper[3:, 1] = 0.0, 0.02, 0.05
    gap = Gap(upper, lower, np.random.default_rng(0), options)
    void = gap.void(np.concatenate([upper, lower]).ravel(), before=[upper, lower])
    assert void.volumes[:3] == pytest.approx(np.zeros(3), abs=1e-16)
    assert void.volumes[4:].min() > 1e-3


def test_mouths_take_in_what_the_void_gains_without_its_soil():
    """A block that slides over a step in the base: new facing points at the same places."""
    rng = np.random.default_rng(5)
    options = MortarOptions()
    lower = flat(np.linspace(3.0, -2.0, 23), 0.0) + rng.normal(size=(23, 2)) * 0.004
    upper = flat(np.linspace(0.0, 1.0, 8), 0.1) + rng.normal(size=(8, 2)) * 0.004
    gap = Gap(upper, lower, rng, options)
    start = [upper, lower]
    first = gap.void(np.concatenate(start).ravel(), before=start)
    moved = [upper + np.array([0.31, 0.01]), lower]
    second = gap.void(np.concatenate(moved).ravel(), before=start)
    gained = second.volumes.sum() - first.volumes.sum()
    taken_in = second.swept(first.mouths)
    assert abs(taken_in) > 1e-4
    assert gained == pytest.approx(second.growth.sum() + taken_in, abs=1e-15)


def ring(radii, start, first, inwards=False):
    """A closed surface about the origin, the body outside of it; or the body inside."""
    n = len(radii)
    angle = start - 2.0 * np.pi * np.arange(n) / n
    if inwards:
        angle, radii = angle[::-1], radii[::-1]
    points = radii[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    at = np.arange(n, dtype=np.int32)
    return Surface("ring", at + first, at + first, points, np.column_stack([at, np.roll(at, -1)]))


@pytest.mark.parametrize("turn", [0.0, 1.0, 3.0, 5.5])
@pytest.mark.parametrize("radius", [5.0, 1.2])
def test_surfaces_that_close_in_themselves(turn, radius):
    """A pipe in a hole with a niche, wherever the first nodes are."""
    options = MortarOptions(search_radius=radius)
    angles = turn - 2.0 * np.pi * np.arange(24) / 24
    hole = ring(1.1 + 0.6 * np.exp(-20.0 * (np.cos(angles) - 1.0) ** 2), turn, 0)
    pipe = ring(np.ones(31), 0.3, 100, inwards=True)
    before = ring(np.hypot(*hole.points.T) - 0.01, turn, 0)
    segments = mortar_segments(hole, pipe, options)
    coupling = mortar_operator(hole, pipe, segments, None, options)
    d = geometry_derivatives(hole, pipe, segments, coupling)
    opening = np.full(24, 0.1)
    void = Void((hole, pipe), (before, pipe), segments, coupling, coupling.kept, opening, d)
    exact = [-area(surface.points) - area(pipe.points) for surface in (hole, before)]
    assert void.volumes.sum() == pytest.approx(exact[0], rel=1e-12)
    assert void.growth.sum() == pytest.approx(exact[0] - exact[1], rel=1e-12)
    assert not void.mouths and void.swept(void.mouths) == 0.0
    assert void.pressing.sum(axis=0).reshape(-1, 2).sum(axis=0) == pytest.approx([0, 0], abs=1e-13)
