"""How the axes of all figures look: two spines, a light grid, gray words."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK, GRAY = "#22262b", "#6b7280"


def plain_axes(axes: Axes) -> None:
    """Left and bottom spine, ticks and grid in grays."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#9aa1ab")
    axes.tick_params(which="both", color="#9aa1ab", labelcolor=GRAY, labelsize=9)
    axes.grid(True, color="#e6e8eb", linewidth=0.8)
    axes.set_axisbelow(True)
