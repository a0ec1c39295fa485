# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bearing capacity of a strip footing against Prandtl's."""

from mpi4py import MPI

import numpy as np
import pytest

import demos.verification.strip_footing as demo

pytestmark = pytest.mark.mpi
EXACT = 2.0 + np.pi


def pushed(words, comm=MPI.COMM_WORLD):
    """A footing pushed as these words say, and its figures."""
    footing = demo.Footing(demo.parse(words.split())[0], comm)
    footing.push()
    return footing, footing.figures()


def test_load_is_prandtls_and_does_not_lock():
    footing, figures = pushed("--h 0.5 --steps 15")
    assert EXACT < figures["q_over_c"] < 6.4
    assert figures["q_over_c_corrected"] == pytest.approx(EXACT, rel=0.06)
    assert figures["plateau_slope"] < 0.4
    assert figures["newton_mean"] <= 4 and figures["failed_steps"] == 0
    # Newton's method: residuals fall quadratically at the end of a step.
    history = max((step.result.history for step in footing.steps), key=len)
    worst = [max(residuals) for residuals in history]
    assert worst[-1] < 10.0 * worst[-2] ** 1.5


@pytest.mark.parametrize("nu", [0.3, 0.4999])
def test_nearly_incompressible_soil_carries_no_more(nu):
    settlement = 1.0 if nu < 0.4 else 0.3
    _, figures = pushed(f"--h 0.5 --steps 20 --nu {nu} --settlement {settlement}")
    assert figures["q_over_c_corrected"] == pytest.approx(EXACT, rel=0.07)


def test_pore_water_without_time_to_leave_is_incompressible():
    _, figures = pushed("--h 0.5 --steps 15 --undrained")
    assert figures["q_over_c_corrected"] == pytest.approx(EXACT, rel=0.07)
    assert figures["newton_mean"] <= 4


def test_triangles_lock():
    _, figures = pushed("--h 0.5 --steps 15 --smoothing triangles")
    assert figures["q_over_c_corrected"] > 1.3 * EXACT


def test_a_smooth_base_carries_as_much():
    _, figures = pushed("--h 0.5 --steps 15 --smooth-base")
    assert figures["q_over_c_corrected"] == pytest.approx(EXACT, rel=0.08)


def test_ranks_do_not_matter():
    comm = MPI.COMM_WORLD
    if comm.size == 1:
        pytest.skip("needs several ranks")
    words = "--h 0.5 --steps 6 --settlement 0.12"
    together = pushed(words)[0].history["q_over_c"]
    alone = pushed(words, MPI.COMM_SELF)[0].history["q_over_c"]
    np.testing.assert_allclose(together, alone, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("h", "tolerance"), [(0.25, 0.01), (0.125, 0.011)])
def test_load_converges(h, tolerance):
    _, figures = pushed(f"--h {h}")
    assert figures["q_over_c_corrected"] == pytest.approx(EXACT, rel=tolerance)


@pytest.mark.slow
def test_cohesion_of_dilatant_soil():
    """On quadratic triangles; smoothed ones are too stiff where soil dilates."""
    _, figures = pushed("--phi 25 --E 1e8 --smoothing quadratic")
    assert figures["q_over_c_corrected"] == pytest.approx(figures["q_over_c_exact"], rel=0.02)
