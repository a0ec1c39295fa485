# SPDX-License-Identifier: LGPL-3.0-or-later
"""Speed of the return mappings; run with -m benchmark -s. No time is asserted."""

import time

from mpi4py import MPI

import numpy as np
import pytest

import fenicsx_hmcontact as hm

pytestmark = [pytest.mark.benchmark, pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="serial")]


def test_a_million_return_mappings():
    n = 1_000_000
    stress = 2e4 * np.random.default_rng(0).normal(size=(n, 4))
    strain = np.zeros((n, 3))
    print("\nprocess seconds for a million points, tangents included")
    for law in (
        hm.LinearElastic(1e6, 0.3),
        hm.Tresca(1e6, 0.3, 1e4),
        hm.Tresca(1e6, 0.3, 1e4, tension_cutoff=0.0),
        hm.MohrCoulomb(1e6, 0.3, 1e4, 30.0, 10.0),
        hm.MohrCoulomb(1e6, 0.3, 1e4, 30.0, 10.0, tension_cutoff=0.0),
    ):
        history = law.initial_history(n)
        law.update(stress[:10], strain[:10], history[:10])
        times = []
        for _ in range(3):
            start = time.process_time()
            update = law.update(stress, strain, history)
            times.append(time.process_time() - start)
        plastic = (update.stress != stress).any(axis=1).mean()
        print(f"  {min(times):.2f}  {plastic:4.0%} plastic  {law}")
        assert (plastic > 0.5) == isinstance(law, hm.ElasticPlastic)
