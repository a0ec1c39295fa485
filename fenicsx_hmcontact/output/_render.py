# SPDX-License-Identifier: LGPL-3.0-or-later
"""Draw one picture with pyvista, in a process of its own: ``python _render.py DATA.npz PNG``.

Without a rendering library VTK kills its process, so none that computes may call this. It imports
nothing of the package, and so no MPI.
"""

import json
import sys

import numpy as np
import pyvista as pv

BAR = 280
"""Width [px] kept free on the right for the scalar bar."""


def render(data: str, picture: str) -> None:
    """Draw the field in an ``.npz`` file.

    Args:
        data: File with ``points`` (N, 2), ``cells`` (M, 3), ``values`` (N,) or (M,), ``outline``
            (num_edges, 2) and ``options`` in JSON: name, title, cmap, clim, edges.
        picture: PNG to write.
    """
    with np.load(data) as file:
        points, cells, values, outline = (file[k] for k in ("points", "cells", "values", "outline"))
        options = json.loads(str(file["options"]))
    points = np.column_stack((points, np.zeros(len(points))))
    mesh = pv.PolyData.from_regular_faces(points, cells)
    target = mesh.point_data if len(values) == len(points) else mesh.cell_data
    target[options["name"]] = values

    size = np.maximum(np.ptp(points, axis=0)[:2], 1e-12 * np.ptp(points))
    scale = min(1100 / size[0], 800 / size[1])
    width, height = np.add(np.maximum(size * scale, (260, 320)), (BAR + 60, 120)).astype(int)
    plotter = pv.Plotter(off_screen=True, window_size=[int(width), int(height)])
    plotter.set_background("white")
    field = plotter.add_mesh(
        mesh,
        cmap=options["cmap"],
        clim=options["clim"],
        show_edges=options["edges"],
        edge_color="#555555",
        edge_opacity=0.35,
        lighting=False,
        show_scalar_bar=False,
    )
    lines = pv.PolyData(points, lines=np.column_stack((np.full(len(outline), 2), outline)))
    plotter.add_mesh(lines, color="black", line_width=2, lighting=False)
    bar = plotter.add_scalar_bar(
        options["name"],
        mapper=field.mapper,
        vertical=True,
        position_x=1 - (BAR / 2 + 30) / width,
        position_y=0.12,
        width=70 / width,
        height=0.75,
        title_font_size=20,
        label_font_size=18,
        color="black",
        fmt="%.4g",
        n_labels=5,
    )
    bar.SetVerticalTitleSeparation(20)
    if options["title"]:
        plotter.add_text(options["title"], position="upper_left", font_size=12, color="black")

    plotter.view_xy()
    plotter.enable_parallel_projection()
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    middle[0] += (BAR / 2) / scale
    plotter.camera.focal_point = middle
    plotter.camera.position = np.add(middle, (0, 0, np.ptp(points)))
    plotter.camera.parallel_scale = height / 2 / scale
    plotter.reset_camera_clipping_range()
    plotter.enable_anti_aliasing("ssaa")
    plotter.screenshot(picture)


if __name__ == "__main__":
    render(*sys.argv[1:])
