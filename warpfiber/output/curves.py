"""What figures of a run show: columns of `scalars.csv`, their words and their colors.

Symbols: a_ij orientation tensor; x, y, z = 1, 2, 3. Colors: x red, y green, z blue throughout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from warpfiber.output.axes_style import GRAY, INK
from warpfiber.output.cell_picture import AXIS_COLORS

BLUE, ORANGE, GREEN, PURPLE = "#2f6db5", "#d97b29", "#2a9d6f", "#8458a8"
RED = "#c0445a"


@dataclass(frozen=True)
class Curves:
    """One figure: its file name, its words, and for each column a label and a color."""

    name: str
    title: str
    ylabel: str
    columns: Mapping[str, tuple[str, str]]
    ylim: tuple[float, float] | None = None
    logarithmic: bool = False
    least: float = -np.inf  # what a value must exceed for the figure to be drawn
    along: str = ""  # the column that it is drawn against; empty: strain or time


FIGURES = (
    Curves(
        "orientation",
        "Orientation tensor",
        "component, weighted by length",
        {
            "a11": ("$a_{11}$  flow", AXIS_COLORS[0]),
            "a22": ("$a_{22}$  vorticity", AXIS_COLORS[1]),
            "a33": ("$a_{33}$  gradient", AXIS_COLORS[2]),
        },
        ylim=(0.0, 1.0),
    ),
    Curves(
        "orientation_number",
        "Orientation tensor",
        "component, one vote per fiber",
        {
            "a11_fiber": ("$a_{11}$  flow", AXIS_COLORS[0]),
            "a22_fiber": ("$a_{22}$  vorticity", AXIS_COLORS[1]),
            "a33_fiber": ("$a_{33}$  gradient", AXIS_COLORS[2]),
        },
        ylim=(0.0, 1.0),
    ),
    Curves(
        "interactions",
        "Interactions and contacts",
        "number per fiber",
        {
            "interactions_per_fiber": ("interactions", BLUE),
            "contacts_per_fiber": ("contacts", ORANGE),
            "coordination_number": ("touching fibers", GREEN),
        },
        ylim=(0.0, np.inf),
    ),
    Curves(
        "overlap",
        "Overlap of fibers in contact",
        "overlap / fiber radius",
        {"overlap_max": ("largest", ORANGE), "overlap_mean": ("mean", BLUE)},
        ylim=(0.0, np.inf),
    ),
    Curves(
        "bending",
        "Bending",
        "strain of the surface by bending",
        {"bending_strain_max": ("largest", ORANGE), "bending_strain_mean": ("mean", BLUE)},
        ylim=(0.0, np.inf),
        least=1e-12,  # rods do not bend
    ),
    Curves(
        "stress",
        "Stress of the fibers",
        "stress (Pa)",
        {
            "stress_13": ("shear", BLUE),
            "stress_contact_13": ("of it contact", GREEN),
            "normal_difference_1": ("$N_1$", ORANGE),
            "normal_difference_2": ("$N_2$", PURPLE),
        },
    ),
    Curves(
        "viscosity",
        "Relative viscosity",
        "viscosity of the suspension / of the fluid",
        {"relative_viscosity": ("", BLUE)},
        ylim=(0.0, np.inf),
    ),
    Curves(
        "energy",
        "Energies",
        "energy (J)",
        {
            "energy_kinetic": ("kinetic", BLUE),
            "energy_stretching": ("stretching", GREEN),
            "energy_shear": ("shear", RED),
            "energy_bending": ("bending", ORANGE),
            "energy_twist": ("twist", INK),
            "energy_repulsion": ("repulsion", PURPLE),
            "energy_wall": ("walls", GRAY),
            "energy_contact": ("contacts", PURPLE),
        },
        logarithmic=True,
    ),
    Curves(
        "pressure",
        "Pressure on walls",
        "pressure (Pa)",
        {"pressure_low": ("lower", ORANGE), "pressure_high": ("upper", BLUE)},
    ),
    Curves(
        "compression",
        "Pressure on the upper wall",
        "pressure (Pa)",
        {"pressure_high": ("", BLUE)},
        least=0.0,
        along="volume_fraction",
    ),
    Curves(
        "drawn",
        "Stress on the upper grip",
        "stress (Pa)",
        {"stress_zz": ("zz", BLUE), "stress_xz": ("xz", ORANGE)},
        along="grip_strain",
    ),
    Curves(
        "axial_strain",
        "Axial strain of segments",
        "largest |axial strain|",
        {"axial_strain_max": ("largest", ORANGE)},
        ylim=(0.0, np.inf),
        least=1e-9,  # rods do not stretch
    ),
    Curves(
        "angle", "Rotation in the flow-gradient plane", "mean angle (rad)", {"angle": ("", BLUE)}
    ),
)
