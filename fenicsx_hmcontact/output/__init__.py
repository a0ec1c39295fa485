# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a run leaves behind: fields for ParaView, figures, and its report."""
