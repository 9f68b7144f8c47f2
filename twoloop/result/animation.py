"""Animation of a mechanism as an HTML page, GIF or film: lines, fixed points, and the paths of some points."""

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

from twoloop.checks.arguments import Array, check_path, check_positive
from twoloop.checks.optional import needed
from twoloop.run.record import Record

RATE = 25  # frames per second
SHORTEST, LONGEST = 3.0, 12.0  # s, unless the user gives a duration
AZIMUTH, ELEVATION = -60.0, 22.0  # degrees: view of a spatial mechanism
WIDTH, HEIGHTS, MARGIN = 480, (200, 480), 28  # pixels
COLORS = 64  # palette size of a GIF
FINER = 2  # oversampling factor, for antialiasing
FINER_PATHS = 4  # points of a path per frame
STILL = 1e-3  # relative to the extent: a point that moves less counts as fixed
JOINTS_MOST = 12  # largest number of points of a planar mechanism drawn as circles
BAR, TRACE, FIXED, PAPER = "#1f4e79", "#e07b39", "#444444", "#ffffff"
SUFFIXES = (".html", ".gif", ".mp4")


@dataclass(frozen=True)
class Scene:
    """Contents of the frames.

    Attributes
    ----------
    name : str
    times : ndarray (n,)
        Times of the frames, s.
    points : ndarray (n_points, 2 or 3, n)
    paths : ndarray (n_traces, 2 or 3, FINER_PATHS (n - 1) + 1)
        Paths drawn.
    bars, traces, fixed, joints : list
        Pairs of points connected by a line; points with paths, fixed points, and points drawn as circles.
    """

    name: str
    times: Array
    points: Array
    paths: Array
    bars: list[tuple[int, int]]
    traces: list[int]
    fixed: list[int]
    joints: list[int]


def animate(result: Record, path: str | os.PathLike[str], seconds: float | None) -> Path:
    """Write an animation, see `Result.animate`."""
    path = check_path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"path must end in {', '.join(SUFFIXES)}; given {str(path)!r}")
    if seconds is not None:
        check_positive("seconds", seconds)
    if result.t.size < 2:
        raise ValueError(f"animate needs a result of two times at least; this one has {result.t.size}")
    duration = float(result.t[-1] - result.t[0])
    length = min(max(duration, SHORTEST), LONGEST) if seconds is None else float(seconds)
    scene = _scene(result, max(2, round(length * RATE) + 1))
    if path.suffix.lower() == ".html":
        path.write_text(page(scene), encoding="utf-8")
    elif path.suffix.lower() == ".gif":
        made = pictures(scene)
        palette = made[-1].quantize(COLORS)  # from the last frame, which has the whole paths
        first, *others = [picture.quantize(palette=palette, dither=0) for picture in made]
        first.save(path, save_all=True, append_images=others, duration=1000 // RATE, loop=0, optimize=True)
    else:
        _film(scene, path)
    return path


def _scene(result: Record, n_frames: int) -> Scene:
    drawing = result._known("drawing")
    times = np.linspace(result.t[0], result.t[-1], n_frames)
    fine = np.linspace(result.t[0], result.t[-1], FINER_PATHS * (n_frames - 1) + 1)
    all_points = drawing.at(_positions(result, fine))
    points = all_points[..., ::FINER_PATHS]
    moved = np.ptp(points, axis=2).max(axis=1)
    fixed = np.flatnonzero(moved <= STILL * np.ptp(points, axis=(0, 2)).max()).tolist()
    planar = points.shape[1] == 2 and len(points) <= JOINTS_MOST
    joints = [k for k in range(len(points)) if k not in fixed and (planar or k in drawing.traces)]
    name = "" if result.system is None else result.system.name
    paths = all_points[list(drawing.traces)]
    return Scene(name, times, points, paths, list(drawing.bars), list(drawing.traces), fixed, joints)


def _positions(result: Record, times: Array) -> Array:
    """Return the coordinates (n_q, n) at the times of the frames."""
    if result.sol is not None:
        return np.asarray(result.sol(times).q)
    from scipy.interpolate import BPoly  # slow to import

    states = np.stack([result.q.T, result.v.T, result.a.T], axis=1)
    made = np.empty((len(result.q), len(times)))
    first = np.append(0, np.flatnonzero(np.diff(result.t) == 0.0) + 1)  # starts of the arcs between impacts
    for begin, end in zip(first, np.append(first[1:], len(result.t)), strict=True):
        if end - begin > 1:
            own = (times >= result.t[begin]) & (times <= result.t[end - 1])
            made[:, own] = BPoly.from_derivatives(result.t[begin:end], states[begin:end])(times[own]).T
    return made


def page(scene: Scene) -> str:
    """Return a self-contained HTML page with the points as numbers and a script that draws them."""
    extent = float(np.ptp(scene.points, axis=(0, 2)).max()) or 1.0
    decimals = max(0, 4 - int(np.floor(np.log10(extent))))
    data = {
        "times": [float(f"{t:.6g}") for t in scene.times],
        "frames": np.moveaxis(np.round(scene.points, decimals), 2, 0).tolist(),
        "paths": np.moveaxis(np.round(scene.paths, decimals), 2, 1).tolist(),
        "perFrame": FINER_PATHS,
        "bars": scene.bars,
        "traces": scene.traces,
        "fixed": scene.fixed,
        "joints": scene.joints,
        "rate": RATE,
        "azimuth": AZIMUTH,
        "elevation": ELEVATION,
        "colors": {"bar": BAR, "trace": TRACE, "fixed": FIXED},
    }
    template = Path(__file__).with_name("animation.html").read_text(encoding="utf-8")
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    return template.replace("NAME", html.escape(scene.name)).replace("DATA", text, 1)


def projected(points: Array) -> Array:
    """Project points in space (n_points, 3, n) to the view plane, (n_points, 2, n); planar points are unchanged."""
    if points.shape[1] == 2:
        return points
    a, e = np.radians([AZIMUTH, ELEVATION])
    seen = np.array([[-np.sin(a), np.cos(a), 0.0], [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]])
    return np.einsum("ij,kjt->kit", seen, points)


def pictures(scene: Scene) -> list[Any]:
    """Return a Pillow image for each frame."""
    image, draw = (needed(f"PIL.{module}", "pillow", "a GIF or a film") for module in ("Image", "ImageDraw"))
    seen, paths = projected(scene.points), projected(scene.paths)
    both = np.concatenate([np.moveaxis(each, 1, 0).reshape(2, -1) for each in (seen, paths)], axis=1)
    low, high = both.min(axis=1), both.max(axis=1)
    spans = np.maximum(high - low, 1e-12)
    height = int(np.clip((WIDTH - 2 * MARGIN) * spans[1] / spans[0] + 2 * MARGIN, *HEIGHTS)) // 2 * 2
    size = np.array([WIDTH, height])
    scale = ((size - 2 * MARGIN) / spans).min()
    flip = np.array([1.0, -1.0])
    pixels, trails = (
        FINER * (0.5 * size[:, None] + flip[:, None] * scale * (each - 0.5 * (low + high)[:, None]))
        for each in (seen, paths)
    )
    made = []
    for frame, t in enumerate(scene.times):
        picture = image.new("RGB", (FINER * WIDTH, FINER * height), PAPER)
        pen = draw.Draw(picture)
        _paint(pen, scene, pixels[..., frame], trails[..., : FINER_PATHS * frame + 1])
        pen.text((FINER * 8, FINER * 6), f"{scene.name}   t = {t:.3g} s", fill=FIXED, font_size=FINER * 13)
        made.append(picture.resize((WIDTH, height), image.Resampling.LANCZOS))
    return made


def _paint(pen: Any, scene: Scene, pixels: Array, trails: Array) -> None:
    """Draw a frame: points (n_points, 2), and the paths (n_traces, 2, m) up to it."""

    def dot(point: int, radius: float, shape: str, **colors: str) -> None:
        x, y = pixels[point]
        getattr(pen, shape)((x - radius, y - radius, x + radius, y + radius), **colors)

    for trail in trails:
        pen.line([tuple(point) for point in trail.T], fill=TRACE, width=FINER, joint="curve")
    thick = FINER * (3 if scene.points.shape[1] == 2 else 2)
    for bar in scene.bars:
        pen.line([tuple(pixels[end]) for end in bar], fill=BAR, width=thick)
    for point in scene.fixed:
        dot(point, FINER * 4, "rectangle", fill=FIXED)
    for point in scene.joints:
        dot(point, FINER * 3, "ellipse", fill=TRACE if point in scene.traces else PAPER, outline=BAR)


def _film(scene: Scene, path: Path) -> None:
    program = shutil.which("ffmpeg")
    if program is None:
        raise RuntimeError("an .mp4 needs the program ffmpeg, not found on the PATH: install it, or write .gif, .html")
    made = pictures(scene)
    width, height = made[0].size
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(RATE), "-i", "-"]
    command = [program, "-y", "-loglevel", "error", *raw, "-pix_fmt", "yuv420p", str(path)]
    done = subprocess.run(command, input=b"".join(each.tobytes() for each in made), capture_output=True)
    if done.returncode != 0:
        raise RuntimeError(f"ffmpeg could not write {str(path)!r}: {done.stderr.decode(errors='replace').strip()}")
