# SPDX-License-Identifier: LGPL-3.0-or-later
"""Loops over arrays, compiled by numba; nothing here knows DOLFINx or the rest of the package."""
