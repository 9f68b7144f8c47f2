"""Show a result as a pandas table, as plots, and as an animation: HTML page, GIF or film."""

from __future__ import annotations

import html
import json
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from twoloop.checks.arguments import Array, check_path, check_positive, needed
from twoloop.problem.description import name_and_unit
from twoloop.run.record import Record


def to_dataframe(result: Record) -> Any:
    """Return the run as a pandas table with one row per time.

    Returns
    -------
    pandas.DataFrame
        Indexed by "t (s)". Columns: coordinates by name, such as "x of crank (m)", their velocities "x of crank,
        velocity (m/s)" and accelerations, the multipliers lam0, lam1, ..., "energy (J)" if it is known, and in
        models of bodies the joint coordinates "angle of hinge (rad)", counted over turns, and "angle of hinge, rate
        (rad/s)". An angle in space is NaN from where stored times are too far apart to count its turns.

    Raises
    ------
    ImportError
        If pandas is not installed.
    """
    pandas = needed("pandas", "pandas", "to_dataframe")
    coordinates = result.coordinates
    columns = dict(zip(coordinates, result.q, strict=True))
    for quantity, values, per in (("velocity", result.v, "s"), ("acceleration", result.a, "s^2")):
        columns |= {_derivative(name, quantity, per): row for name, row in zip(coordinates, values, strict=True)}
    columns |= {f"lam{k}": row for k, row in enumerate(result.lam)}
    if result.description.energy is not None:
        columns["energy (J)"] = result.energy
    for joint in result.description.joint_coordinates:
        columns[f"{joint.name} ({joint.unit})"] = joint.history(result)
        columns[_derivative(f"{joint.name} ({joint.unit})", "rate", "s")] = joint.rate(result.q, result.v)
    return pandas.DataFrame(columns, index=pandas.Index(result.t, name="t (s)"))


def _derivative(coordinate: str, quantity: str, per: str) -> str:
    """Return the name of a derivative with its unit, e.g. "x of crank, velocity (m/s)" for "x of crank (m)"."""
    name, unit = name_and_unit(coordinate)
    return f"{name}, {quantity} ({unit or 1}/{per})"


PANEL_WIDTH, PANEL_HEIGHT = 8.0, 2.2  # inches
MAX_LEGEND = 12  # largest number of coordinates in a legend


def plot(result: Record, path: str | os.PathLike[str] | None = None) -> Any:
    """Plot the coordinates, the energy and the violation of the constraints over time; needs no display.

    One panel per unit of the coordinates, and of the joint coordinates of a model of bodies; the energy, minus its
    initial value if it is an invariant; the largest violation of the position and of the velocity constraints at
    each time of `t`. Unknown quantities are omitted.

    Parameters
    ----------
    path : str or path, optional
        File to which the figure is saved, in the matplotlib format given by its suffix.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    ValueError
        If the result has no stored times.
    """
    file = None if path is None else check_path(path)
    if result.t.size == 0:
        raise ValueError(f"plot needs a result with output; this one has none: {result.message}")
    # a figure without pyplot needs no display, and does not affect the user's backend
    figure_class = needed("matplotlib.figure", "matplotlib", "plot").Figure
    units: dict[str, list[int]] = {}
    for k, coordinate in enumerate(result.coordinates):
        units.setdefault(name_and_unit(coordinate)[1], []).append(k)
    description = result.description
    joints: dict[str, list[Any]] = {}
    for joint in description.joint_coordinates:
        joints.setdefault(joint.unit, []).append(joint)
    n_panels = len(units) + len(joints) + (description.energy is not None) + (result.system is not None)
    figure = figure_class(figsize=(PANEL_WIDTH, PANEL_HEIGHT * n_panels + 0.5), layout="constrained")
    if file is not None and file.suffix and file.suffix[1:].lower() not in figure.canvas.get_supported_filetypes():
        raise ValueError(f"path must end in .png, .svg, .pdf or another format of matplotlib; given {str(path)!r}")
    panels = list(np.atleast_1d(figure.subplots(n_panels, 1, sharex=True)))
    remaining = iter(panels)
    for unit, indices in units.items():
        curves = [(name_and_unit(result.coordinates[k])[0], result.q[k]) for k in indices]
        _curves(next(remaining), result.t, f"q ({unit})" if unit else "q", curves, "coordinates")
    for unit, coordinates in joints.items():
        curves = [(each.name, each.history(result)) for each in coordinates]
        _curves(next(remaining), result.t, f"joints ({unit})", curves, "joint coordinates")
    if description.energy is not None:
        energy, panel = result.energy, next(remaining)
        panel.plot(result.t, energy - energy[0] if description.conserved else energy, color="tab:red")
        panel.set_ylabel("energy − start (J)" if description.conserved else "energy (J)")
    if result.system is not None:
        _violation(next(remaining), result)
    panels[-1].set_xlabel("t (s)")
    name = "" if result.system is None else result.system.name
    figure.suptitle(name if result.success else f"{name}: {result.status.name}", fontsize="medium")
    if file is not None:
        figure.savefig(file, dpi=150)
    return figure


def _curves(panel: Any, t: Array, label: str, curves: list[tuple[str, Array]], noun: str) -> None:
    for name, values in curves:
        panel.plot(t, values, lw=1.0, label=name)
    panel.set_ylabel(label)
    if len(curves) <= MAX_LEGEND:
        panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="x-small")
    else:
        panel.set_title(f"{len(curves)} {noun}", fontsize="x-small")


def _violation(panel: Any, result: Record) -> None:
    positions, velocities = violation(result)
    for values, label in ((positions, "|C|"), (velocities, "|d/dt C|, |A v + b|")):
        if (values > 0.0).any():  # a logarithmic axis cannot show zeros
            panel.semilogy(result.t, np.where(values > 0.0, values, np.nan), lw=1.0, label=label)
        else:
            panel.plot([], [], label=f"{label}: 0")
    panel.set_ylabel("largest violation")
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="x-small")


def violation(result: Record) -> tuple[Array, Array]:
    """Return the largest violations of the position and of the velocity constraints, (n_t,) each."""
    system: Any = result.system
    states = list(zip(result.t.tolist(), result.q.T, result.v.T, strict=True))
    positions = [np.abs(system.constraint(t, q)).max(initial=0.0) if system.n_c else 0.0 for t, q, _ in states]
    velocities = [np.abs(system.velocity_constraint(t, q, v)).max(initial=0.0) for t, q, v in states]
    return np.array(positions), np.array(velocities)


FRAME_RATE = 25  # frames per second
SHORTEST, LONGEST = 3.0, 12.0  # limits of the duration of an animation, s, unless the user gives the duration
AZIMUTH, ELEVATION = -60.0, 22.0  # degrees: view of a spatial mechanism
WIDTH, HEIGHTS, MARGIN = 480, (200, 480), 28  # width, limits of the height, and margin of a frame, pixels
COLORS = 64  # palette size of a GIF
OVERSAMPLING = 2  # oversampling factor, for antialiasing
PATH_POINTS = 4  # number of points per frame of a drawn path
FIXED_TOLERANCE = 1e-3  # largest movement of a fixed point, relative to the extent of all points
MAX_JOINTS = 12  # largest number of points of a planar mechanism that are drawn as circles
BAR, TRACE, FIXED, PAPER = "#1f4e79", "#e07b39", "#444444", "#ffffff"
SUFFIXES = (".html", ".gif", ".mp4")


@dataclass(frozen=True)
class Scene:
    """Contents of the n frames of an animation."""

    name: str
    times: Array  # times of the frames, s
    points: Array  # (n_points, 2 or 3, n)
    paths: Array  # points of the drawn paths, (n_traces, 2 or 3, PATH_POINTS (n - 1) + 1)
    bars: list[tuple[int, int]]  # pairs of points connected by a line
    traces: list[int]  # points with paths
    fixed: list[int]
    joints: list[int]  # points drawn as circles


def animate(result: Record, path: str | os.PathLike[str], seconds: float | None = None) -> Path:
    """Write an animation of the mechanism from its problem's `drawing`; needs no display.

    Between the stored times the motion is that of `sol`, or without it a polynomial through q, v and a, which
    requires sufficiently dense times with `t_eval`.

    Parameters
    ----------
    path : str or path
        A file with suffix .html (a self-contained page, in which a spatial mechanism can be rotated with the
        mouse), .gif (needs Pillow) or .mp4 (needs Pillow and the program ffmpeg).
    seconds : float, optional
        Duration of the animation. None: that of the run, limited to 3 to 12 s.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    ImportError, RuntimeError
        If Pillow or ffmpeg is required but missing.
    TypeError, ValueError
        If an argument is invalid, there is no drawing, or the run has fewer than two times.
    """
    path = check_path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"path must end in {', '.join(SUFFIXES)}; given {str(path)!r}")
    if seconds is not None:
        check_positive("seconds", seconds)
    if result.t.size < 2:
        raise ValueError(f"animate needs a result of two times at least; this one has {result.t.size}")
    duration = float(result.t[-1] - result.t[0])
    length = min(max(duration, SHORTEST), LONGEST) if seconds is None else float(seconds)
    scene = _scene(result, max(2, round(length * FRAME_RATE) + 1))
    if path.suffix.lower() == ".html":
        path.write_text(_page(scene), encoding="utf-8")
    elif path.suffix.lower() == ".gif":
        frames = _frames(scene)
        palette = frames[-1].quantize(COLORS)  # from the last frame, which has the whole paths
        first, *following = [picture.quantize(palette=palette, dither=0) for picture in frames]
        first.save(path, save_all=True, append_images=following, duration=1000 // FRAME_RATE, loop=0, optimize=True)
    else:
        _write_film(scene, path)
    return path


def _scene(result: Record, n_frames: int) -> Scene:
    drawing = result._description_value("drawing")
    times = np.linspace(result.t[0], result.t[-1], n_frames)
    path_times = np.linspace(result.t[0], result.t[-1], PATH_POINTS * (n_frames - 1) + 1)
    all_points = drawing.at(_positions(result, path_times))
    points = all_points[..., ::PATH_POINTS]
    movements = np.ptp(points, axis=2).max(axis=1)
    fixed = np.flatnonzero(movements <= FIXED_TOLERANCE * np.ptp(points, axis=(0, 2)).max()).tolist()
    planar = points.shape[1] == 2 and len(points) <= MAX_JOINTS
    joints = [k for k in range(len(points)) if k not in fixed and (planar or k in drawing.traces)]
    name = "" if result.system is None else result.system.name
    paths = all_points[list(drawing.traces)]
    return Scene(name, times, points, paths, list(drawing.bars), list(drawing.traces), fixed, joints)


def _positions(result: Record, times: Array) -> Array:
    """Return the coordinates (n_q, n) at `times` (n,), from `sol` or by Hermite interpolation of q, v and a."""
    if result.sol is not None:
        return np.asarray(result.sol(times).q)
    from scipy.interpolate import BPoly  # slow to import

    states = np.stack([result.q.T, result.v.T, result.a.T], axis=1)
    positions = np.empty((len(result.q), len(times)))
    first = np.append(0, np.flatnonzero(np.diff(result.t) == 0.0) + 1)  # starts of the arcs between impacts
    for begin, end in zip(first, np.append(first[1:], len(result.t)), strict=True):
        if end - begin > 1:
            in_arc = (times >= result.t[begin]) & (times <= result.t[end - 1])
            positions[:, in_arc] = BPoly.from_derivatives(result.t[begin:end], states[begin:end])(times[in_arc]).T
    return positions


def _page(scene: Scene) -> str:
    """Return a self-contained HTML page with the points as numbers and a script that draws them."""
    extent = float(np.ptp(scene.points, axis=(0, 2)).max()) or 1.0
    decimals = max(0, 4 - int(np.floor(np.log10(extent))))
    data = {
        "times": [float(f"{t:.6g}") for t in scene.times],
        "frames": np.moveaxis(np.round(scene.points, decimals), 2, 0).tolist(),
        "paths": np.moveaxis(np.round(scene.paths, decimals), 2, 1).tolist(),
        "perFrame": PATH_POINTS,
        "bars": scene.bars,
        "traces": scene.traces,
        "fixed": scene.fixed,
        "joints": scene.joints,
        "rate": FRAME_RATE,
        "azimuth": AZIMUTH,
        "elevation": ELEVATION,
        "colors": {"bar": BAR, "trace": TRACE, "fixed": FIXED},
    }
    template = Path(__file__).with_name("animation.html").read_text(encoding="utf-8")
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    return template.replace("NAME", html.escape(scene.name)).replace("DATA", text, 1)


def _projected(points: Array) -> Array:
    """Project points in space (n_points, 3, n) to the view plane, (n_points, 2, n); planar points are unchanged."""
    if points.shape[1] == 2:
        return points
    a, e = np.radians([AZIMUTH, ELEVATION])
    axes = np.array([[-np.sin(a), np.cos(a), 0.0], [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]])
    return np.einsum("ij,kjt->kit", axes, points)


def _frames(scene: Scene) -> list[Any]:
    """Return a Pillow image for each frame."""
    image, draw = (needed(f"PIL.{module}", "pillow", "a GIF or a film") for module in ("Image", "ImageDraw"))
    points, paths = _projected(scene.points), _projected(scene.paths)
    corners = np.concatenate([np.moveaxis(part, 1, 0).reshape(2, -1) for part in (points, paths)], axis=1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    spans = np.maximum(high - low, 1e-12)
    height = int(np.clip((WIDTH - 2 * MARGIN) * spans[1] / spans[0] + 2 * MARGIN, *HEIGHTS)) // 2 * 2
    size = np.array([WIDTH, height])
    scale = ((size - 2 * MARGIN) / spans).min()
    flip = np.array([1.0, -1.0])
    pixels, trails = (
        OVERSAMPLING * (0.5 * size[:, None] + flip[:, None] * scale * (part - 0.5 * (low + high)[:, None]))
        for part in (points, paths)
    )
    frames = []
    for frame, t in enumerate(scene.times):
        picture = image.new("RGB", (OVERSAMPLING * WIDTH, OVERSAMPLING * height), PAPER)
        pen = draw.Draw(picture)
        _draw_frame(pen, scene, pixels[..., frame], trails[..., : PATH_POINTS * frame + 1])
        pen.text(
            (OVERSAMPLING * 8, OVERSAMPLING * 6),
            f"{scene.name}   t = {t:.3g} s",
            fill=FIXED,
            font_size=OVERSAMPLING * 13,
        )
        frames.append(picture.resize((WIDTH, height), image.Resampling.LANCZOS))
    return frames


def _draw_frame(pen: Any, scene: Scene, pixels: Array, trails: Array) -> None:
    """Draw a frame by `pen`: points (n_points, 2) and the paths so far (n_traces, 2, m), both in pixels."""

    def dot(point: int, radius: float, shape: str, **colors: str) -> None:
        x, y = pixels[point]
        getattr(pen, shape)((x - radius, y - radius, x + radius, y + radius), **colors)

    for trail in trails:
        pen.line([tuple(point) for point in trail.T], fill=TRACE, width=OVERSAMPLING, joint="curve")
    thick = OVERSAMPLING * (3 if scene.points.shape[1] == 2 else 2)
    for bar in scene.bars:
        pen.line([tuple(pixels[end]) for end in bar], fill=BAR, width=thick)
    for point in scene.fixed:
        dot(point, OVERSAMPLING * 4, "rectangle", fill=FIXED)
    for point in scene.joints:
        dot(point, OVERSAMPLING * 3, "ellipse", fill=TRACE if point in scene.traces else PAPER, outline=BAR)


def _write_film(scene: Scene, path: Path) -> None:
    program = shutil.which("ffmpeg")
    if program is None:
        raise RuntimeError("an .mp4 needs the program ffmpeg, not found on the PATH: install it, or write .gif, .html")
    frames = _frames(scene)
    width, height = frames[0].size
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(FRAME_RATE), "-i", "-"]
    command = [program, "-y", "-loglevel", "error", *raw, "-pix_fmt", "yuv420p", str(path)]
    process = subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), capture_output=True)
    if process.returncode != 0:
        raise RuntimeError(f"ffmpeg could not write {str(path)!r}: {process.stderr.decode(errors='replace').strip()}")
