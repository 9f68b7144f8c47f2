"""Which integrator, solref and time step MuJoCo needs on the closed loops of an MJCF file."""

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
CHANGE = 1.4  # by how much a setting must be cheaper than one that changes less of the file
ENDINGS = (".json", ".csv")


@dataclass(frozen=True)
class MjcfAudit:
    """What MuJoCo is off by on a file, as it is and with stiffer loops; `print(audit)`.

    Attributes
    ----------
    file, start : str
        What was run, and from where.
    left_out : tuple of str
        What neither motion has: contacts, actuators, limits, ...
    notes : tuple of str
    as_it_is : str
        The error at the step of the file.
    audits : tuple of Audit
        As the file is; with loops as stiff as a step allows; so, and with RK4.
    advice : str
        What to write into the file for the error asked for, and what it costs; empty if nothing tried reaches it.
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
        """Write everything as JSON, or the runs as CSV, by the ending of the path.

        Raises
        ------
        ValueError
            If it ends otherwise.
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
    """What is left out; of several joints as "limits of 8 joints"."""
    parts = [each.partition(" of joint ")[::2] for each in left_out]
    found: dict[str, None] = {}
    for each, (what, joint) in zip(left_out, parts, strict=True):
        n = sum(own == what and bool(name) for own, name in parts)
        found[f"{what} of {n} joints" if joint and n > 1 else each] = None
    return list(found)


def check_ending(file: Path) -> None:
    """Raise a ValueError if an audit cannot be written to a file of this name."""
    if file.suffix not in ENDINGS:
        raise ValueError(f"--out takes a file that ends in {' or '.join(ENDINGS)}; given {str(file)!r}")


def _row(run: AuditedRun) -> dict[str, Any]:
    return {name: None if value != value else value for name, value in run._asdict().items()}


def audit_mjcf(
    path: str | os.PathLike[str], *, error: float = 1e-3, t_end: float = 2.0, key: str | None = None
) -> MjcfAudit:
    """Compare MuJoCo's motion of a file with the motion of its rigid loops, and find what an error takes.

    Steps and settings are tried in turn: those of the file, then loops as stiff as a step allows (solref of twice the
    step, the least that MuJoCo takes unless told otherwise), with the file's integrator and with RK4.

    Parameters
    ----------
    path : path-like
        An MJCF file with loops closed by connect or weld.
    error : float, optional
        Asked for: the largest of any body's centre (m) or axes over the motion.
    t_end : float, optional
        How long the motion is followed, s.
    key : str, optional
        Keyframe from which it starts, by its name, or its number if it has none. None: the pose of the file, at rest.

    Returns
    -------
    MjcfAudit

    Raises
    ------
    RuntimeError
        If MuJoCo is not installed, or the motion of rigid loops is not known to that error.
    ValueError
        If an argument is wrong, the file has no loop, nothing moves, or MuJoCo's model of masses, springs, dampers and
        loops is not the one that `from_mjcf` reads.

    Notes
    -----
    `twoloop.bodies.from_mjcf` says what is read. What it ignores is switched off in MuJoCo, too, and listed.
    """
    check_positive("error", error)
    check_positive("t_end", t_end)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IgnoredWarning)  # listed instead
        model = from_mjcf(path)
    inside = InMuJoCo(path, model)
    mujoco = inside.mujoco
    mujoco.set_mju_user_warning(lambda text: None)  # which it would put into a file in the folder of the caller
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
    notes += [f"Loops gaped by {gap:.2g} m there: they are closed first."] if gap > MOVED else []
    others = [name for name in inside.keyframes if name != key]
    notes += [f"Other starts, by --key: {', '.join(others)}."] if others else []
    floor = audits[-1].floor or 0.0
    if floor > error:
        notes.append(
            f"Even stiff loops with RK4 end at an error of {floor:.2g}, where none is expected: motions part too fast, "
            "or MuJoCo moves another mechanism than the one that was read. Do not trust this audit."
        )
    left_out = tuple(each for each in model.ignored if not each.startswith(("sensor", "keyframe")))
    start = "the pose of the file" if key is None else f"the keyframe {key!r}"
    advice = _advice(inside, audits)
    as_it_is = _at(audits[0], inside.step)
    return MjcfAudit(os.fspath(path), start, left_out, tuple(notes), as_it_is, tuple(audits), advice)


def _at(audit: Audit, step: float) -> str:
    """What the file is off by at its own step, of the runs the one that is nearest."""
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
    """What to write into the file: of the settings that reach the error the cheapest, or nearly."""
    costs = {k: run.cpu_s for k, audit in enumerate(audits) if (run := audit.reaching)}
    if not costs:
        return ""
    k = next(k for k, cost in costs.items() if cost <= CHANGE * min(costs.values()))  # the least change
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
