# SPDX-License-Identifier: LGPL-3.0-or-later
"""Modified Cam-clay: a material as a user writes it, in NumPy, with an implicit return mapping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import fenicsx_hmcontact as hm

TOLERANCE = 1e-12
"""Miss of flow rule and yield condition, relative to kappa and the preconsolidation pressure."""

MAX_ITERATIONS = 50

MEAN = np.array([1.0, 1.0, 1.0, 0.0]) / 3.0
DEVIATOR = np.eye(4) - np.outer([1.0, 1.0, 1.0, 0.0], MEAN)
STRAIN = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.5]])
TWICE = np.array([1.0, 1.0, 1.0, 2.0])  # xy and yx


@dataclass(frozen=True)
class CamClay:
    """Modified Cam-clay (Roscoe and Burland 1968) with the compression lines of Butterfield (1979).

    Elastic: p = p_n exp(de_v / kappa), shear modulus in proportion to the pressure p_n at the start
    of the step. Yield: q^2 / M^2 + p (p - p_c) = 0, associated; p_c = p_c,n exp(de_v^p / (lam -
    kappa)). Mean stress p and volumetric strain e_v are positive in compression here. History: the
    preconsolidation pressure p_c [Pa].

    Attributes:
        M: Slope q/p of the critical state line [-].
        lam: Slope of the compression line in e_v against ln p, lambda / (1 + e) [-].
        kappa: Slope of the swelling lines, likewise [-].
        nu: Poisson's ratio [-].
        p_c: Preconsolidation pressure at the start [Pa].
    """

    M: float
    lam: float
    kappa: float
    nu: float
    p_c: float

    history_names = ("p_c",)

    def __post_init__(self) -> None:
        if not 0.0 < self.kappa < self.lam:
            raise ValueError(f"kappa is {self.kappa}; it must lie between 0 and lam, {self.lam}")

    def initial_history(self, n):
        return np.full((n, 1), self.p_c)

    def update(self, stress, strain, history):
        if not (stress @ MEAN < 0.0).all():
            raise ValueError("Cam-clay has no stiffness without compression: set the stress first")
        start, p_c = (stress, strain), history[:, 0]
        # Unknown: plastic volumetric strain, and multiplier times p_c of the start of the step.
        unknown = np.zeros((len(stress), 2))
        new_stress, new_p_c, miss, slopes = self._state(*start, p_c, unknown)
        active = np.flatnonzero(miss[:, 1] > 0.0)
        for _ in range(MAX_ITERATIONS):
            if active.size == 0:
                break
            matrix = slopes[1][active][:, :, 7:]
            unknown[active] -= np.linalg.solve(matrix, miss[active, :, None])[..., 0]
            part = self._state(stress[active], strain[active], p_c[active], unknown[active])
            new_stress[active], new_p_c[active], miss[active] = part[:3]
            slopes[0][active], slopes[1][active] = part[3]
            active = active[~(np.abs(miss[active]).max(axis=1) < TOLERANCE)]
        # Implicit differentiation: the unknowns of plastic points follow the inputs.
        by_input = slopes[0][:, :, :7].copy()
        plastic = np.flatnonzero(unknown.any(axis=1))
        follow = -np.linalg.solve(slopes[1][plastic][:, :, 7:], slopes[1][plastic][:, :, :7])
        by_input[plastic] += slopes[0][plastic][:, :, 7:] @ follow
        flagged = np.zeros(len(stress), bool)
        flagged[active] = True
        return hm.MaterialUpdate(
            new_stress,
            new_p_c[:, None],
            by_input[:, :, 4:],
            by_input[:, :, :4],
            flagged,
            "the return mapping of Cam-clay did not converge",
        )

    def _state(self, stress, strain, p_c, unknown):
        """Stress, p_c, what flow rule and yield condition miss, and the slopes of stress and miss.

        Slopes are by stress at the start, strain increment and unknowns; shapes (n, ., 4 + 3 + 2).
        """
        n = len(stress)
        plastic, multiplier = unknown.T
        volume = -(strain[:, 0] + strain[:, 1])
        by = np.zeros((4, n, 9))  # of p_n, elastic volume, plastic volume, multiplier
        by[0, :, :4] = -MEAN
        by[1, :, 4:6] = -1.0
        by[1, :, 7] = -1.0
        by[2, :, 7] = by[3, :, 8] = 1.0

        def times(factor, slope):
            return np.asarray(factor)[:, None] * slope

        p_n = -stress @ MEAN
        swelling = np.exp((volume - plastic) / self.kappa)
        p = p_n * swelling
        dp = times(swelling, by[0]) + times(p / self.kappa, by[1])
        hardening = np.exp(plastic / (self.lam - self.kappa))
        pc = p_c * hardening
        dpc = times(pc / (self.lam - self.kappa), by[2])

        ratio = 1.5 * (1.0 - 2.0 * self.nu) / (1.0 + self.nu) / self.kappa  # G / p_n
        e = strain @ (DEVIATOR @ STRAIN).T
        shrink = 1.0 + 6.0 * ratio * p_n * multiplier / (self.M**2 * p_c)
        d_shrink = times((shrink - 1.0) / p_n, by[0])
        d_shrink += times(6.0 * ratio * p_n / (self.M**2 * p_c), by[3])
        s = (stress @ DEVIATOR.T + 2.0 * ratio * p_n[:, None] * e) / shrink[:, None]
        ds = 2.0 * ratio * e[:, :, None] * by[0][:, None, :]
        ds[:, :, :4] += DEVIATOR
        ds[:, :, 4:7] += 2.0 * ratio * p_n[:, None, None] * (DEVIATOR @ STRAIN)
        ds = (ds - s[:, :, None] * d_shrink[:, None, :]) / shrink[:, None, None]

        q2 = 1.5 * (s * s) @ TWICE
        dq2 = 3.0 * np.einsum("ni,nij->nj", s * TWICE, ds)
        flow = plastic - multiplier * (2.0 * p - pc) / p_c
        d_flow = (
            by[2] - times((2.0 * p - pc) / p_c, by[3]) - times(multiplier / p_c, 2.0 * dp - dpc)
        )
        f = q2 / self.M**2 + p * (p - pc)
        df = dq2 / self.M**2 + times(2.0 * p - pc, dp) - times(p, dpc)
        miss = np.column_stack((flow / self.kappa, f / p_c**2))
        d_miss = np.stack((d_flow / self.kappa, df / p_c[:, None] ** 2), axis=1)
        one = np.array([1.0, 1.0, 1.0, 0.0])
        new_stress, slope = s - p[:, None] * one, ds - one[:, None] * dp[:, None, :]
        return new_stress, pc, miss, (slope, d_miss)
