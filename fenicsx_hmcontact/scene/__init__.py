# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scenes: bodies, contacts, supports, loads and drainage by the names of gmsh groups."""

from .model import ModelOptions, SceneModel
from .scene import Scene

__all__ = ["ModelOptions", "Scene", "SceneModel"]
