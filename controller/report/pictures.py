"""Drawings as SVG, in one style. Texts become outlines, so that a picture looks the same in HTML and PDF."""

import io
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Final

import numpy as np

from controller.report.view import Budget, Ellipsoids, Picture, Residuals, ToleranceBar
from estimation.transform import FloatArray

INK: Final = "#1f2933"
MUTED: Final = "#8a94a0"
FAINT: Final = "#dfe3e8"
ACCENT: Final = "#1d5b8f"
STRONG: Final = "#c25e00"  # the one that matters: worst point, outlier
COLOURS: Final = {"OK": "#1a7f4b", "NotOK": "#b3261e", "NotDecidable": "#a86200", "Undefined": "#5f6368"}

STYLE: Final[Mapping[str, Any]] = {
    "svg.fonttype": "path",
    "svg.hashsalt": "truecell",  # same data, same file
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.6,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
}

TURN: Final = np.linspace(0.0, 2.0 * np.pi, 181)
PROJECTIONS: Final = (("x", "y", (0, 1)), ("x", "z", (0, 2)))
NAMED_POINTS: Final = 4  # with more, only the worst is named


def draw(picture: Picture) -> str:
    """One <svg> element; its ids begin with the picture's key, so that many fit into one page."""
    match picture.drawing:
        case ToleranceBar():
            return _tolerance_bar(picture.drawing, picture.title)
        case Ellipsoids():
            svg = _ellipsoids(picture.drawing)
        case Budget():
            svg = _budget(picture.drawing)
        case Residuals():
            svg = _residuals(picture.drawing)
    return _inline(svg, picture)


def _figure(width_in: float, height_in: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def _styled() -> Any:
    from matplotlib import rc_context

    settings: Any = dict(STYLE)  # the stubs list every key as a literal
    return rc_context(settings)


def _svg(figure: Any) -> str:
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    return buffer.getvalue()


def _inline(svg: str, picture: Picture) -> str:
    """Without the head of a file, named for readers that cannot see it, ids made unique."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{picture.key}-', svg)
    svg = re.sub(r'href="#', f'href="#{picture.key}-', svg)
    svg = svg.replace("url(#", f"url(#{picture.key}-")
    return svg.replace("<svg", f'<svg role="img" aria-label="{_escaped(picture.title)}"', 1)


def _escaped(text: str) -> str:
    from html import escape

    return escape(text, quote=True)


def ellipse_outline(axes: FloatArray, directions: FloatArray, plane: tuple[int, int]) -> FloatArray:
    """Outline (2, n) of the shadow that an ellipsoid casts along the third axis; `directions` are rows."""
    shape = directions.T @ np.diag(axes**2) @ directions
    values, vectors = np.linalg.eigh(shape[np.ix_(plane, plane)])
    circle = np.stack([np.cos(TURN), np.sin(TURN)])
    outline: FloatArray = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
    return outline


def _ellipsoids(drawing: Ellipsoids) -> str:
    reach = 1.22 * max(drawing.limit_mm, *(max(point.axes_mm) for point in drawing.points))
    bar = _round_length(0.5 * reach)
    with _styled():
        figure = _figure(4.4, 2.15)
        panels = figure.subplots(1, 2)
        for panel, (across, up, plane) in zip(panels, PROJECTIONS, strict=True):
            limit = drawing.limit_mm * np.stack([np.cos(TURN), np.sin(TURN)])
            panel.fill(*limit, color="#f3f6f9", zorder=0)
            panel.plot(*limit, color=MUTED, linewidth=0.9, linestyle=(0, (4, 2.5)))
            panel.plot([-reach, reach], [0, 0], color=FAINT, linewidth=0.5, zorder=0.5)
            panel.plot([0, 0], [-reach, reach], color=FAINT, linewidth=0.5, zorder=0.5)
            named = len(drawing.points) <= NAMED_POINTS
            for i, point in enumerate(drawing.points):
                outline = ellipse_outline(np.array(point.axes_mm), np.array(point.directions), plane)
                colour = STRONG if point.worst else ACCENT
                strength = 1.0 if point.worst else 0.45 + 0.4 * i / len(drawing.points) if named else 0.4
                panel.plot(
                    *outline,
                    color=colour,
                    alpha=strength,
                    linewidth=1.3 if point.worst else 0.9,
                    label=f"{point.name} (worst)" if point.worst else point.name if named else None,
                    zorder=3 if point.worst else 2,
                )
            if not named:
                panel.plot([], [], color=ACCENT, alpha=0.4, linewidth=0.9, label="other gated points")
            panel.set(xlim=(-reach, reach), ylim=(-1.15 * reach, 1.05 * reach), aspect="equal")
            panel.set_axis_off()
            panel.annotate(across, (reach, 0), ha="right", va="bottom", color=MUTED)
            panel.annotate(
                up, (0, reach), ha="left", va="top", color=MUTED, xytext=(2, 0), textcoords="offset points"
            )
            panel.plot(
                [-reach, -reach + bar], [-1.1 * reach] * 2, color=INK, linewidth=1.6, solid_capstyle="butt"
            )
            panel.annotate(
                f"{bar:g} mm",
                (-reach + bar, -1.1 * reach),
                xytext=(3, 0),
                textcoords="offset points",
                va="center",
                fontsize=6.5,
            )
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(
            handles,
            labels,
            loc="outside lower center",
            ncols=min(len(labels), 3),
            frameon=False,
            fontsize=6.5,
            handlelength=1.6,
            columnspacing=1.4,
        )
        return _svg(figure)


def _round_length(length: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= length))


def _budget(drawing: Budget) -> str:
    names = [name for name, _ in drawing.bars]
    parts = 100.0 * np.array([part for _, part in drawing.bars])
    with _styled():
        figure = _figure(3.1, 2.15)
        panel = figure.subplots()
        places = np.arange(len(parts))
        panel.barh(places, parts, height=0.62, color=[STRONG] + [ACCENT] * (len(parts) - 1))
        for place, part in zip(places, parts, strict=True):
            panel.annotate(
                f"{part:.0f} %" if part >= 0.5 else "< 1 %",
                (part, place),
                xytext=(3, 0),
                textcoords="offset points",
                va="center",
                fontsize=6.5,
            )
        panel.set_yticks(places, names)
        panel.set(xlim=(0, 1.18 * parts.max()), ylim=(len(parts) - 0.4, -0.6))
        panel.spines["bottom"].set_visible(False)
        panel.tick_params(axis="x", bottom=False, labelbottom=False)
        panel.tick_params(axis="y", length=0)
        return _svg(figure)


def _residuals(drawing: Residuals) -> str:
    values = np.array(drawing.standardised)
    reach = max(3.6, 1.08 * float(np.abs(values).max()))
    with _styled():
        figure = _figure(7.3, 1.35)
        panel, side = figure.subplots(1, 2, sharey=True, width_ratios=(6, 1))
        for sigma, colour, dash in ((2, MUTED, (0, (4, 3))), (3, STRONG, (0, (4, 3)))):
            for sign in (-1, 1):
                panel.axhline(sign * sigma, color=colour, linewidth=0.7, linestyle=dash)
        panel.axhline(0, color=FAINT, linewidth=0.7)
        number = np.arange(1, len(values) + 1)
        outside = np.abs(values) > 3
        panel.vlines(number, 0, values, color=FAINT, linewidth=0.8)
        panel.scatter(number[~outside], values[~outside], s=7, color=ACCENT, linewidths=0, zorder=3)
        panel.scatter(number[outside], values[outside], s=14, color=STRONG, linewidths=0, zorder=3)
        panel.set(xlim=(0, len(values) + 1), ylim=(-reach, reach), ylabel="residual / σ")
        panel.set_xlabel("measurement", labelpad=1)
        panel.set_yticks([-3, -2, 0, 2, 3])
        panel.xaxis.get_major_locator().set_params(integer=True)
        height = np.linspace(-reach, reach, 161)
        bins = np.arange(-np.ceil(reach), np.ceil(reach) + 0.5, 0.5)
        side.hist(values, bins=bins, density=True, orientation="horizontal", color=ACCENT, alpha=0.35)
        side.plot(np.exp(-(height**2) / 2) / np.sqrt(2 * np.pi), height, color=INK, linewidth=0.8)
        side.spines["bottom"].set_visible(False)
        side.tick_params(bottom=False, labelbottom=False, left=False, labelleft=False)
        return _svg(figure)


BAR_WIDTH: Final = 150
BAR_HEIGHT: Final = 16
ZONE: Final = (30.0, 120.0)  # where the tolerance zone begins and ends


def _tolerance_bar(bar: ToleranceBar, title: str) -> str:
    """Zone, acceptance zone, value and U; what lies outside the picture ends in an arrow."""
    left, right = ZONE if bar.two_sided else (4.0, ZONE[1])
    width = right - left
    colour = COLOURS.get(bar.outcome, COLOURS["Undefined"])
    middle = BAR_HEIGHT / 2

    def place(fraction: float) -> float:
        return min(max(left + fraction * width, 4.0), BAR_WIDTH - 6.0)

    shapes = [f'<rect x="{left:g}" y="3" width="{width:g}" height="{BAR_HEIGHT - 6}" fill="#e4ecf3"/>']
    if bar.guard is not None:
        start = bar.guard if bar.two_sided else 0.0
        inner = max(0.0, 1.0 - bar.guard - start) * width
        shapes.append(
            f'<rect x="{left + start * width:.2f}" y="3" width="{inner:.2f}" height="{BAR_HEIGHT - 6}" '
            'fill="#bfd3e4"/>'
        )
    edges = (left, right) if bar.two_sided else (right,)
    shapes += [
        f'<line x1="{x:g}" y1="1" x2="{x:g}" y2="{BAR_HEIGHT - 1}" stroke="{INK}" stroke-width="1"/>'
        for x in edges
    ]
    low, high = place(bar.value - bar.expanded_u), place(bar.value + bar.expanded_u)
    shapes.append(
        f'<line x1="{low:.2f}" y1="{middle:g}" x2="{high:.2f}" y2="{middle:g}" stroke="{colour}" '
        'stroke-width="1.6"/>'
    )
    x = place(bar.value)
    if left + bar.value * width > BAR_WIDTH - 6.0:
        points = f"{x - 3:.2f},{middle - 4:g} {x + 5:.2f},{middle:g} {x - 3:.2f},{middle + 4:g}"
        shapes.append(f'<polygon points="{points}" fill="{colour}"/>')
    elif left + bar.value * width < 4.0:
        points = f"{x + 3:.2f},{middle - 4:g} {x - 4:.2f},{middle:g} {x + 3:.2f},{middle + 4:g}"
        shapes.append(f'<polygon points="{points}" fill="{colour}"/>')
    else:
        shapes.append(f'<circle cx="{x:.2f}" cy="{middle:g}" r="3.2" fill="{colour}"/>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="{_escaped(title)}" '
        f'width="{BAR_WIDTH}" height="{BAR_HEIGHT}" viewBox="0 0 {BAR_WIDTH} {BAR_HEIGHT}">'
        f"{''.join(shapes)}</svg>"
    )


@lru_cache(maxsize=1)
def font_folder() -> str:
    """The fonts that come with matplotlib: the same on every machine."""
    from matplotlib import get_data_path

    return f"{get_data_path()}/fonts/ttf"
