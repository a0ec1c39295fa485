# SPDX-License-Identifier: LGPL-3.0-or-later
"""Finite strain against exact solutions: consolidation, rotation, shear, compression, pressing."""

from mpi4py import MPI

import numpy as np
import pytest

import demos.verification.finite_rotation as rotating
import demos.verification.large_strain_consolidation as consolidation
import demos.verification.pressed_block as pressing
from fenicsx_hmcontact.output.report import Report
from tests.models import largest

pytestmark = pytest.mark.mpi
COMM = MPI.COMM_WORLD
SMOOTHINGS = ["full", "none", "triangles"]


def options_of(demo, words=""):
    return demo.parse(words.split())[0]


def report():
    return Report("test", COMM, {})


# --- consolidation -------------------------------------------------------------------------------


@pytest.mark.parametrize("stretch", [0.9, 0.7, 0.3])
def test_exact_consolidation_begins_with_the_root_of_time(stretch):
    options = options_of(consolidation, f"--stretch {stretch}")
    times = [1e3, 1e4, 3e4]
    early = consolidation.early_settlement(options, np.array(times))
    errors = [
        np.abs(consolidation.Exact(options, times, volumes=n).settlement / early - 1.0).max()
        for n in (100, 200)
    ]
    assert errors[1] < 5e-4 and 3.5 < errors[0] / errors[1] < 4.5


def consolidate(*words):
    """Run the demo; history, errors, and report."""
    options = consolidation.parse(words)[0]
    column, result = consolidation.Column(options, options.smoothing, options.rows), report()
    history = consolidation.run(column, options.refine, result, bar="")
    return history, consolidation.compare(history, options)[1], result


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_consolidation_by_a_third(smoothing):
    words = "--rows", "10", "--smoothing", smoothing, "--schedule", "10x1e3 9x1e4"
    history, errors, result = consolidate(*words)
    # Backward Euler in these steps: about 1 % too small
    assert -0.012 < errors["settlement_error"]["1e5"] < -0.005
    assert errors["pressure_error"]["100000"] < 0.02
    assert history.balance < 1e-10
    assert result.newton_iterations <= 4 * result.steps and not history.cuts


@pytest.mark.slow
def test_consolidation_to_the_end_is_of_first_order_in_time():
    settlement = {"1e5": [], "5e5": []}
    for refine in (1, 2, 4):
        history, errors, _ = consolidate("--rows", "40", "--refine", str(refine))
        assert history.balance < 1e-9
        for t, error in errors["settlement_error"].items():
            settlement[t].append(error)
    assert abs(settlement["1e5"][0]) < 0.012 and abs(settlement["5e5"][0]) < 0.021
    for errors in settlement.values():
        assert 1.8 < errors[0] / errors[1] < 2.2 and 1.8 < errors[1] / errors[2] < 2.2


# --- rotation, shear, compression ----------------------------------------------------------------


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_stress_turns_with_the_body(smoothing):
    for words in ("--degrees 90", "--degrees -200 --steps 3"):
        options = options_of(rotating, f"{words} --smoothing {smoothing}")
        assert rotating.turn_stress(options) < 1e-13


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_turned_beam_is_in_equilibrium(smoothing):
    words = f"--across 16 --rows 2 --bending-steps 4 --steps 4 --degrees 70 --smoothing {smoothing}"
    options = options_of(rotating, words)
    figures, _ = rotating.turn_beam(options, report())
    assert figures["relaxations"] < options.relaxations
    assert figures["bent_residual"] < 1e-11
    assert figures["rotated_residual"] < 1e-10
    if smoothing == "full":
        # Points on fixed axes would see stresses that are not in equilibrium.
        assert figures["residual_on_fixed_axes"] > 0.1


@pytest.mark.slow
def test_beam_bends_as_the_elastica():
    """But for shear, which adds about 0.6 % of deflection."""
    options = options_of(rotating, "--across 160 --rows 16")
    figures, _ = rotating.turn_beam(options, report())
    for name, exact in figures["tip_elastica"].items():
        assert figures["tip"][name] == pytest.approx(exact, rel=0.015)
    exact = rotating.elastica(4.0)
    # Bisshop and Drucker (1945)
    assert np.allclose(exact, (0.32894, 0.66996), atol=1e-5)


@pytest.mark.parametrize("smoothing", ["full", "triangles"])
def test_shear_and_compression_are_of_second_order(smoothing):
    words = f"--nu 0.3 --smoothing {smoothing}"
    errors = []
    for steps in (10, 20):
        options = options_of(rotating, f"{words} --steps {steps} --shear 2")
        sheared = rotating.shear(options)[0]
        options = options_of(rotating, f"{words} --steps {steps} --compression 0.3")
        compressed = rotating.compression(options)[0]
        assert sheared["scatter"] < 1e-12 and compressed["scatter"] < 1e-12
        errors.append([sheared["shear_error"], -compressed["compression_error"]])
    assert np.all(np.array(errors[0]) < (3.1e-3, 1.2e-4))
    assert np.allclose(np.array(errors[0]) / errors[1], 4.0, rtol=0.02)


# --- pressing ------------------------------------------------------------------------------------


def press(words):
    """Press the block of the demo; iterations of the steps, orders of convergence, the block."""
    body = pressing.Block(options_of(pressing, words))
    steps = list(body.press())
    orders = [pressing.order_of([max(r) for r in s.result.history]) for s in steps]
    assert not any(step.cuts for step in steps)
    return [s.iterations for s in steps], [order for order in orders if order], body


@pytest.mark.parametrize("smoothing", ["full", "triangles"])
def test_newton_is_quadratic(smoothing):
    iterations, orders, _ = press(f"--cells 6 --smoothing {smoothing}")
    assert max(iterations) <= 3
    assert orders and np.median(orders) > 1.8


@pytest.mark.parametrize("drainage", [0.1, 1e8])
def test_water_is_no_obstacle_to_newton(drainage):
    """Pressures up to half of Young's modulus; fully drained they change nothing."""
    words = "--cells 6 --steps 4"
    iterations, _, wet = press(f"{words} --water-pressure 5e5 --drainage {drainage}")
    assert max(iterations) <= 4
    if drainage > 1.0:
        _, _, dry = press(words)
        assert largest(wet.u.x.array - dry.u.x.array, COMM) < 1e-8
        assert wet.force() - 5e5 == pytest.approx(dry.force(), rel=1e-8)


@pytest.mark.slow
def test_plastic_block():
    iterations, orders, body = press("--material tresca --steps 30")
    assert np.mean(iterations) < 6
    assert np.median(orders) > 1.7
    assert largest(body.skeleton.history("kappa"), COMM) > 0.3
