# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials of the solid skeleton."""

from .linear_elastic import LinearElastic

__all__ = ["LinearElastic"]
