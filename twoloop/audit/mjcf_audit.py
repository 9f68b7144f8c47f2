"""Finds the integrator, solref and time step that MuJoCo needs for the closed loops of an MJCF file."""

import csv
import json
import os
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from twoloop.audit.mjcf_in_mujoco import MOVED, InMuJoCo, Settings
from twoloop.audit.step_audit import Audit, AuditedRun, audit_simulator
from twoloop.bodies.mjcf_geometry import IgnoredWarning
from twoloop.bodies.mjcf_reader import from_mjcf
from twoloop.checks.arguments import check_positive
from twoloop.run.projection import consistent_state

CANDIDATES = (Settings(stiff=True), Settings("RK4", stiff=True))
CHANGE = 1.4  # a setting that changes more of the file must be cheaper by this factor
ENDINGS = (".json", ".csv")


@dataclass(frozen=True)
class MjcfAudit:
    """Errors of MuJoCo on a file, as given and with stiffer loops; `print(audit)` shows them.

    Attributes
    ----------
    file, start : str
        The file, and the initial state.
    left_out : tuple of str
        Parts of the file that are omitted from both motions: contacts, actuators, limits, ...
    notes : tuple of str
    as_it_is : str
        Description of the error at the step of the file.
    audits : tuple of Audit
        With the settings of the file; with loops as stiff as the step allows; the same with RK4.
    advice : str
        Settings for the requested error and their cost; empty if none of the audits reaches it.

    Examples
    --------
    >>> from twoloop.audit import MjcfAudit
    >>> audit = MjcfAudit("linkage.xml", "its pose", ("contacts",), (), "error 0.02", (), "")
    >>> audit.left_out
    ('contacts',)
    """

    file: str
    start: str
    left_out: tuple[str, ...]
    notes: tuple[str, ...]
    as_it_is: str
    audits: tuple[Audit, ...]
    advice: str

    def __str__(self) -> str:
        first = self.audits[0]
        head = [f"{self.file}: MuJoCo against rigid loops, {first.t_end:g} s from {self.start}", *self.notes]
        head += [f"Neither motion has: {'; '.join(_counted(self.left_out))}."] if self.left_out else []
        head += [
            "error: largest of any body's centre (m) or axes; two references of rigid loops differ by "
            f"{first.apart:.1g}",
            "",
        ]
        best = min((run.error for audit in self.audits for run in audit.runs if not run.message), default=np.nan)
        end = self.advice or f"Nothing tried reaches an error of {first.error:g}; the smallest is {best:.2g}."
        return "\n".join([*head, *(f"{audit}\n" for audit in self.audits), self.as_it_is, end])

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write everything as JSON, or the runs as CSV, by the suffix of the path.

        Raises
        ------
        ValueError
            If the suffix is neither.
        """
        file = Path(path)
        check_ending(file)
        if file.suffix == ".json":
            audits = [
                {
                    **{name: getattr(each, name) for name in ("label", "t_end", "error", "apart", "order", "floor")},
                    "runs": [_row(run) for run in each.runs],
                    "reaching": _row(each.reaching) if each.reaching else None,
                }
                for each in self.audits
            ]
            known = {name: getattr(self, name) for name in ("file", "start", "left_out", "notes", "as_it_is", "advice")}
            file.write_text(json.dumps({**known, "audits": audits}, indent=1) + "\n", encoding="utf-8")
            return
        with file.open("w", encoding="utf-8", newline="") as stream:
            table = csv.DictWriter(stream, ["label", *AuditedRun._fields])
            table.writeheader()
            table.writerows({"label": each.label, **_row(run)} for each in self.audits for run in each.runs)


def _counted(left_out: tuple[str, ...]) -> list[str]:
    """Return what is left out, with several items combined, e.g. "limits of 8 joints"."""
    parts = [each.partition(" of joint ")[::2] for each in left_out]
    found: dict[str, None] = {}
    for each, (what, joint) in zip(left_out, parts, strict=True):
        n = sum(own == what and bool(name) for own, name in parts)
        found[f"{what} of {n} joints" if joint and n > 1 else each] = None
    return list(found)


def check_ending(file: Path) -> None:
    """Raise ValueError if an audit cannot be written to a file with this suffix."""
    if file.suffix not in ENDINGS:
        raise ValueError(f"--out takes a file that ends in {' or '.join(ENDINGS)}; given {str(file)!r}")


def _row(run: AuditedRun) -> dict[str, Any]:
    return {name: None if value != value else value for name, value in run._asdict().items()}


def audit_mjcf(
    path: str | os.PathLike[str], *, error: float = 1e-3, t_end: float = 2.0, key: str | None = None
) -> MjcfAudit:
    """Compare MuJoCo's motion of a file with that of its rigid loops, and find settings for a requested error.

    Three settings are run with several steps: those of the file, then loops as stiff as the step allows (solref of
    twice the step, the smallest value that MuJoCo accepts by default), with the file's integrator and with RK4.

    Parameters
    ----------
    path : path-like
        An MJCF file with loops closed by connect or weld.
    error : float, optional
        Requested error: the largest over all times of any body's centre (m) or axes.
    t_end : float, optional
        Duration of the motion, s.
    key : str, optional
        Name of the initial keyframe, or its number if unnamed. None: the pose of the file, at rest.

    Returns
    -------
    MjcfAudit

    Raises
    ------
    RuntimeError
        If MuJoCo is not installed, or the reference motion is less accurate than the requested error.
    ValueError
        If an argument is invalid, the file has no loop, nothing moves, or MuJoCo's masses, springs, dampers or loops
        differ from those of `from_mjcf`.

    Notes
    -----
    Parts of the file ignored by `twoloop.bodies.from_mjcf` are disabled in MuJoCo as well, and listed.

    Examples
    --------
    It needs MuJoCo.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from twoloop.audit import audit_mjcf
    >>> TEXT = '''
    ... <mujoco>
    ...   <default>
    ...     <geom type="capsule" size="0.02" mass="1" contype="0" conaffinity="0"/>
    ...     <joint axis="0 1 0"/>
    ...   </default>
    ...   <worldbody>
    ...     <body name="crank">
    ...       <joint/>
    ...       <geom fromto="0 0 0 0.1 0 0.3"/>
    ...       <body name="rod" pos="0.1 0 0.3">
    ...         <joint/>
    ...         <geom fromto="0 0 0 0.7 0 0.1"/>
    ...         <body name="rocker" pos="0.7 0 0.1">
    ...           <joint/>
    ...           <geom fromto="0 0 0 -0.1 0 -0.4"/>
    ...         </body>
    ...       </body>
    ...     </body>
    ...   </worldbody>
    ...   <equality>
    ...     <connect body1="rocker" anchor="-0.1 0 -0.4"/>
    ...   </equality>
    ... </mujoco>
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "linkage.xml"
    ...     _ = path.write_text(TEXT)
    ...     audit = audit_mjcf(path, error=1e-2, t_end=0.2)
    >>> len(audit.audits), bool(audit.advice)
    (3, True)
    """
    check_positive("error", error)
    check_positive("t_end", t_end)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IgnoredWarning)  # listed instead
        model = from_mjcf(path)
    inside = InMuJoCo(path, model)
    mujoco = inside.mujoco
    mujoco.set_mju_user_warning(lambda text: None)  # by default MuJoCo writes them to a file in the working directory
    try:
        qpos, qvel, gap = inside.start(key)
        problem = model.problem((0.0, t_end))
        inside.compare(problem, qpos)
        data = mujoco.MjData(inside.engine)
        data.qpos[:] = qpos
        q, by_v = inside.coordinates(data)
        q, v = consistent_state(problem.system, 0.0, q, by_v @ qvel, check_assembly=False)
        problem = replace(problem, q0=q, v0=v)
        integrator = inside.integrator
        audits = [
            audit_simulator(
                inside.simulator(qpos, qvel, settings),
                problem,
                step=inside.step,
                error=error,
                label=_label(settings, integrator),
            )
            for settings in (Settings(), *(each for each in CANDIDATES if each.integrator != integrator))
        ]
    finally:
        mujoco.set_mju_user_warning(None)
    notes = [problem.note]
    notes += [f"The loops were open by {gap:.2g} m there and are closed first."] if gap > MOVED else []
    others = [name for name in inside.keyframes if name != key]
    notes += [f"Other starts, by --key: {', '.join(others)}."] if others else []
    floor = audits[-1].floor or 0.0
    if floor > error:
        notes.append(
            f"Even stiff loops with RK4 have an error of {floor:.2g}, much more than expected: neighbouring motions "
            "diverge too fast, or MuJoCo's mechanism differs from the one that was read. Do not trust this audit."
        )
    left_out = tuple(each for each in model.ignored if not each.startswith(("sensor", "keyframe")))
    start = "the pose of the file" if key is None else f"the keyframe {key!r}"
    advice = _advice(inside, audits)
    as_it_is = _at(audits[0], inside.step)
    return MjcfAudit(os.fspath(path), start, left_out, tuple(notes), as_it_is, tuple(audits), advice)


def _at(audit: Audit, step: float) -> str:
    """Return the error of the file at its own step, from the run with the nearest step."""
    run = min(audit.runs, key=lambda each: abs(np.log(each.step / step)))
    if not 0.7 < run.step / step < 1.5:
        why = "a 50th of the time, the longest tried" if step > run.step else "the shortest tried"
        return f"As it is the file was not run: its step is {1e3 * step:.4g} ms, and {1e3 * run.step:.4g} ms is {why}."
    return f"As it is, at {1e3 * run.step:.4g} ms: {run.message or f'error {run.error:.2g}, gap {run.gap:.1g} m'}."


def _label(settings: Settings, integrator: str) -> str:
    if settings == Settings():
        return f"as the file is: {integrator}, solref and solimp as given"
    return f"{settings.integrator or integrator}, loops as stiff as the step allows"


def _advice(inside: InMuJoCo, audits: list[Audit]) -> str:
    """Return the settings that reach the error: the cheapest, or the one with fewer changes if it costs little more."""
    costs = {k: run.cpu_s for k, audit in enumerate(audits) if (run := audit.reaching)}
    if not costs:
        return ""
    k = next(k for k, cost in costs.items() if cost <= CHANGE * min(costs.values()))  # fewest changes
    audit, run, settings = audits[k], audits[k].reaching, (Settings(), *CANDIDATES)[k]
    assert run is not None
    option = f'timestep="{run.step:.6g}" integrator="{settings.integrator or inside.integrator}"'
    if settings.stiff and inside.good_solver != inside.solver:
        _, iterations, tolerance = inside.good_solver
        option += f' solver="Newton" iterations="{iterations}" tolerance="{tolerance:g}"'
    lines = [f"For an error of {audit.error:g} (measured {run.error:.2g}, gap {run.gap:.1g} m) write:"]
    lines += [f"  <option {option}/>"]
    if settings.stiff:
        lines += [f'  on every connect and weld: solref="{2.0 * run.step:.6g} 1" solimp="0.9999 0.9999 0.001"']
    factor = audit.t_end / run.cpu_s
    lines += [f"Cost here: {1e3 / factor:.3g} ms of CPU for 1 s of motion, {factor:.3g} times real time."]
    return "\n".join(lines)
