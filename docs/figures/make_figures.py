"""Draw the figures of docs/physics.md and docs/controller/paper.md: robot.svg and wheel_loop.svg.

Run ``python docs/figures/make_figures.py``. This needs the extra ``figures``. The files are written to the
folder of this script.
"""

from __future__ import annotations

import math
from pathlib import Path

import control
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.transforms import Affine2D

from tlf_env.common.files import atomic
from tlf_env.onboard.wheel_loop import WheelLoopParameters, digital_wheel_loop
from tlf_env.physics.vehicle import RobotParameters

FOLDER = Path(__file__).resolve().parent
STYLE = {
    "svg.hashsalt": "tlf_env",
    "font.size": 10,
    "mathtext.fontset": "cm",
    "axes.spines.top": False,
    "axes.spines.right": False,
}
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "0.45"

ROBOT = RobotParameters()
CASTOR_ANGLE = 0.5  # rad, for the drawing
DRIVE_WIDTH_MM, CASTOR_WIDTH_MM = 22.0, 14.0  # for the drawing

KAPPA = 1 / (
    ROBOT.drive_load_share * ROBOT.mass_kg * ROBOT.wheel_radius_mm**2 + ROBOT.wheel_inertia_kg_mm2
)  # eq. (6), 1/(kg·mm²)


def save(figure: Figure, name: str) -> None:
    """Write a figure as a reproducible SVG."""
    with atomic(FOLDER / f"{name}.svg", "wb") as file:
        figure.savefig(file, format="svg", metadata={"Date": None}, facecolor="white")


def arrow(axes: Axes, tail: tuple[float, float], tip: tuple[float, float], colour: str) -> None:
    """Draw a vector."""
    axes.annotate(
        "", tip, tail, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.4, "shrinkA": 0}
    )


def dimension(
    axes: Axes, tail: tuple[float, float], tip: tuple[float, float], label: str, side: float
) -> None:
    """Draw a dimension line; its label is ``side`` (mm) away from its middle."""
    style = {"arrowstyle": "<->", "color": GREY, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tip, tail, arrowprops=style)
    along = np.subtract(tip, tail) / math.dist(tip, tail)
    middle = np.add(tip, tail) / 2 + side * np.array([along[1], -along[0]])
    axes.text(*middle, label, color=GREY, ha="center", va="center")


def wheel(
    axes: Axes, centre: tuple[float, float], radius: float, width: float, turn: float
) -> None:
    """Draw a wheel, seen from above."""
    shape = Rectangle((-width / 2, -radius), width, 2 * radius, fc="0.85", ec="black", zorder=2)
    shape.set_transform(Affine2D().rotate(turn).translate(*centre) + axes.transData)
    axes.add_patch(shape)


def point(axes: Axes, place: tuple[float, float], label: str, offset: tuple[float, float]) -> None:
    """Draw a named point; the label is to the left if ``offset`` (points) is."""
    axes.plot(*place, "o", color="black", ms=4, zorder=5)
    side = "right" if offset[0] < 0 else "left"
    axes.annotate(label, place, offset, textcoords="offset points", ha=side, zorder=5)


def robot() -> Figure:
    """Draw the robot from above: points, lengths, axes and the angle of the castor."""
    p = ROBOT
    figure = Figure(figsize=(6.4, 6.0), layout="constrained")
    axes = figure.subplots()
    axes.set_aspect("equal")
    axes.axis("off")
    half = p.axle_width_mm / 2
    com, pivot = (0.0, -p.com_offset_mm), (0.0, -p.castor_pivot_mm)
    along = np.array([-math.sin(CASTOR_ANGLE), math.cos(CASTOR_ANGLE)])
    across = np.array([math.cos(CASTOR_ANGLE), math.sin(CASTOR_ANGLE)])
    contact = tuple(pivot - p.castor_trail_mm * along)

    axes.add_patch(
        Circle((0, -p.outline_offset_mm), p.outline_radius_mm, fc="0.97", ec=GREY, ls="--", lw=0.9)
    )
    axes.plot([-half, half], [0, 0], color="black", lw=1.2, zorder=1)
    for x in (-half, half):
        wheel(axes, (x, 0), p.wheel_radius_mm, DRIVE_WIDTH_MM, 0.0)
        axes.plot(x, 0, "o", color=RED, ms=4, zorder=5)
    wheel(axes, contact, p.castor_radius_mm, CASTOR_WIDTH_MM, CASTOR_ANGLE)
    axes.plot([pivot[0], contact[0]], [pivot[1], contact[1]], color="black", lw=1.4, zorder=4)
    axes.plot(*contact, "o", color=RED, ms=4, zorder=5)
    point(axes, (0.0, 0.0), "$c$", (6, 5))
    point(axes, com, "centre of mass", (-7, -4))
    point(axes, pivot, "pivot", (-13, -3))

    arrow(axes, (0, 0), (0, 62), BLUE)
    axes.text(0, 69, r"$\mathbf{f}$ (forward, $v_f$)", color=BLUE, ha="center", va="center")
    arrow(axes, (half, 0), (half + 48, 0), BLUE)
    axes.text(half + 52, 0, r"$\mathbf{e}$ (right, $v_e$)", color=BLUE, va="center")
    for vector, label in ((along, r"$\parallel$"), (across, r"$\perp$")):
        tip = contact + 52 * vector
        arrow(axes, contact, tuple(tip), GREEN)
        axes.text(*(contact + 60 * vector), label, color=GREEN, ha="center", va="center")
    # The angle of the fork, measured from straight back.
    axes.plot([0, 0], [pivot[1], pivot[1] - 66], color=GREY, lw=0.8, ls=":")
    end = pivot - 66 * along
    axes.plot([pivot[0], end[0]], [pivot[1], end[1]], color=GREY, lw=0.8, ls=":")
    sweep = np.linspace(0, CASTOR_ANGLE, 30)
    axes.plot(58 * np.sin(sweep), pivot[1] - 58 * np.cos(sweep), color=GREY, lw=0.9)
    axes.text(
        72 * math.sin(CASTOR_ANGLE / 2),
        pivot[1] - 72 * math.cos(CASTOR_ANGLE / 2),
        r"$\varphi$",
        color=GREY,
        ha="center",
        va="center",
    )

    dimension(axes, (-half, 92), (half, 92), f"$L = 2h = {p.axle_width_mm:g}$", -7)
    for x in (-half, half):
        axes.plot([x, x], [52, 97], color=GREY, lw=0.5)
    column = 30.0
    for y in (0.0, com[1], pivot[1]):
        axes.plot([0, column + 4], [y, y], color=GREY, lw=0.5, zorder=0)
    dimension(axes, (column, com[1]), (column, 0), f"$d = {p.com_offset_mm:g}$", 17)
    q_mm = p.castor_pivot_mm - p.com_offset_mm
    dimension(axes, (column, pivot[1]), (column, com[1]), f"$q = {q_mm:g}$", 17)
    middle = (pivot + np.array(contact)) / 2
    axes.plot([middle[0], -36], [middle[1], middle[1] - 14], color=GREY, lw=0.7, zorder=4)
    axes.text(-38, middle[1] - 14, f"$T = {p.castor_trail_mm:g}$", color=GREY, ha="right")
    label = f"outline, radius {p.outline_radius_mm:g}"
    axes.text(-118, -118, label, color=GREY, ha="center")
    axes.text(half + 34, -46, f"$R = {p.wheel_radius_mm:g}$", color=GREY)
    axes.plot([], [], "o", color=RED, ms=4, label="contact with the floor")
    axes.legend(loc="lower right", frameon=False, fontsize=9)
    axes.set_xlim(-150, 186)
    axes.set_ylim(-166, 108)
    return figure


def wheel_loop() -> Figure:
    """Draw the paper's design conditions, and Nyquist curves of the implemented digital loop."""
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    design, nyquist = figure.subplots(1, 2, width_ratios=[1.15, 1])
    conditions(design)
    running_loops(nyquist)
    return figure


def conditions(axes: Axes) -> None:
    """Plot eqs (9)–(11) over frequency, for the slow loop with K in kg·mm²/s² per rad/s."""
    s = control.tf("s")
    loop = WheelLoopParameters()
    K = loop.gain_Nmm_s * (s**2 + loop.zeros_1 * s + loop.zeros_0) / (s * (s + loop.pole_rad_s))
    w_delta, w_e = (s + 1.27) / 2.54, (s + 0.1) / (1.5 * s)  # eq. (12)
    omega = np.geomspace(1e-3, 1e2, 5001)
    L = (K * KAPPA / s)(1j * omega)
    robust = np.abs(w_delta(1j * omega) * L / (1 + L))
    nominal = np.abs(w_e(1j * omega) / (1 + L))
    axes.axhline(1, color="black", lw=0.8)
    lines = (
        (robust, r"(9)  $|W_\delta T|$", BLUE, "--"),
        (nominal, r"(10) $|W_e S|$", GREEN, "-."),
        (robust + nominal, "(11) their sum", RED, "-"),
    )
    for values, label, colour, dashes in lines:
        label = f"{label}, at most {values.max():.3f}"
        axes.semilogx(omega, values, color=colour, ls=dashes, label=label)
    axes.set_xlabel("frequency (rad/s)")
    axes.set_ylim(0, 1.85)
    axes.set_xlim(omega[0], omega[-1])
    axes.set_title("Design loop: condition (11) does not hold", fontsize="medium")
    axes.legend(frameon=False, loc="upper right", fontsize=9)


def running_loops(axes: Axes) -> None:
    """Plot L(e^jωT) of the implemented loop for two periods and two delays; circles: modulus margins."""
    cases = ((0.001, 0, BLUE, "-"), (0.001, 1, GREEN, "--"), (0.005, 1, RED, "-."))
    for period_s, delay, colour, dashes in cases:
        L = running_loop(period_s, delay)
        margin = float(np.abs(1 + L).min())
        samples = "no delay" if delay == 0 else f"{delay} sample of delay"
        axes.plot(
            L.real,
            L.imag,
            color=colour,
            ls=dashes,
            label=f"{1000 * period_s:g} ms, {samples}: margin {margin:.2f}",
        )
        axes.add_patch(Circle((-1, 0), margin, fc="none", ec=colour, lw=0.7, ls=dashes, alpha=0.6))
    axes.plot(-1, 0, "+", color="black", ms=9)
    axes.axhline(0, color=GREY, lw=0.5)
    axes.axvline(0, color=GREY, lw=0.5)
    axes.set_aspect("equal")
    axes.set_xlim(-2.2, 0.9)
    axes.set_ylim(-1.5, 1.9)
    axes.set_xlabel(r"Re $L$")
    axes.set_ylabel(r"Im $L$")
    axes.set_title(r"Running loop, K in N·mm per rad/s", fontsize="medium")
    axes.legend(frameon=False, loc="upper left", fontsize=9)


def running_loop(period_s: float, delay: int) -> np.ndarray:
    """L = K(z) κT/(z − 1) z^−delay up to the Nyquist frequency; κ from eq. (6)."""
    loop = digital_wheel_loop(WheelLoopParameters(), period_s)
    z = np.exp(1j * np.linspace(1e-4, np.pi, 100_001))
    K = loop.gain + loop.integral_step * z / (z - 1) + loop.lag_step * z / (z - loop.lag_decay)
    return K * KAPPA * period_s / (z - 1) * z**-delay


def main() -> None:
    """Write every figure."""
    with matplotlib.rc_context(STYLE):
        for draw in (robot, wheel_loop):
            save(draw(), draw.__name__)


if __name__ == "__main__":
    main()
