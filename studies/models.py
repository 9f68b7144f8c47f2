"""Read files written as public MJCF and URDF files are; compare M, forces and accelerations with MuJoCo's."""

import re
import tempfile
import warnings
from collections import Counter
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from references.driver import imported
from references.engines.mujoco_rows import LOOP_AT, ExactEqualities
from references.model_files.draft import TABLES, Draft
from studies.bench.cli import StudyError, track
from studies.bench.render import power
from studies.bench.store import Output, Row
from studies.bench.study import Study
from twoloop.bodies import Loop, from_mjcf, from_urdf

N_FILES, N_STATES, TOLERANCE = {"MJCF": 31, "URDF": 10}, 2, 1e-9  # files of each kind, states of each file
MEASURES, STATUSES = ("state", "M", "forces", "accelerations"), ("AGREES", "SAID", "SILENT", "REFUSED")
WITHOUT_EFFECT = ("limits", "contact", "friction", "transmission", "gazebo", "safety", "sensor")  # on what is compared


def row_of(form: str, kind: str, number: int) -> Row:
    """Write a file, read it, and compare it with MuJoCo at random states."""
    draft = Draft(form, kind, number)
    row: Row = {"group": form, "case": f"{kind} {number}", "features": ", ".join(sorted(draft.used))}
    row |= {**dict.fromkeys(MEASURES), "ignored": "", "message": ""}
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ours, theirs = draft.write(Path(name))
        try:
            reference = ExactEqualities(theirs, draft.rng, draft.loop)
        except ValueError as error:
            return row | {"status": "NOT_LOADED", "message": str(error).splitlines()[0]}
        try:
            for _ in range(N_STATES):
                reference.draw()
                model = read(draft, ours, reference)
                found = reference.differences(model.problem((0.0, 1.0)), form == "MJCF")
                row |= {what: max(row[what] or 0.0, found[what]) for what in MEASURES}
        except (ValueError, TypeError) as error:  # numpy's errors are ValueErrors
            return row | {"status": "REFUSED", "message": str(error).replace(f"{name}/", "")}
    said = [reason(what) for what in model.ignored if not what.startswith(WITHOUT_EFFECT)]
    status = "AGREES" if max(row[what] for what in MEASURES) < TOLERANCE else "SAID" if said else "SILENT"
    return row | {"status": status, "ignored": "; ".join(sorted(set(said)))}


def read(draft: Draft, path: Path, reference: ExactEqualities) -> Any:
    """Read a file at the state of MuJoCo's data: MJCF in a keyframe, URDF by the positions of its joints."""
    m, d = reference.m, reference.d
    if draft.form == "MJCF":
        values = {name: " ".join(map(repr, getattr(d, name).tolist())) for name in ("qpos", "qvel", "ctrl", "act")}
        key = " ".join(f'{name}="{numbers}"' for name, numbers in values.items() if numbers)
        path.write_text(draft.text.replace("</mujoco>", f"<keyframe><key {key}/></keyframe></mujoco>"))
        return from_mjcf(path, key=0)
    places = {name: float(d.qpos[m.jnt_qposadr[m.joint(name).id]]) for name in draft.singles}
    loops = [Loop("spherical", draft.loop[0], draft.loop[1], LOOP_AT, m.eq_data[-1][3:6])] if draft.loop else []
    more: dict[str, Any] = {"types": dict.fromkeys(draft.balls, "spherical"), "free_base": draft.free}
    return from_urdf(path, loops=loops, positions=places, **more)


def reason(message: str) -> str:
    """Return a message without names and numbers."""
    return re.sub(r",? whose .*|[:;].*(?<!actuator: \w)$| of '.*?'| '.*?'|; given.*", "", message, count=0)


def make(output: Output) -> pd.DataFrame:
    """Make a row for each file."""
    try:
        imported("mujoco", extra="engines")
    except RuntimeError as error:
        raise StudyError(f"{error}; without it there is nothing to compare with") from None
    files = [
        (form, kind, number)
        for form, kind in product(N_FILES, TABLES["kinds"])
        for number in range(1 if output.call.quick else N_FILES[form])
        if output.call.wants(form, f"{kind} {number}")
    ]
    with output.kept() as kept:
        rows = [
            kept.made(" ".join(map(str, file)), partial(row_of, *file)) for file in track(files, str, lambda _: False)
        ]
    return pd.DataFrame(rows)


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Count what agrees, what is refused and why, by format and by subject."""

    def counts(own: pd.DataFrame) -> dict[str, int]:
        return {status: int((own["status"] == status).sum()) for status in STATUSES} | {"files": len(own)}

    loaded = rows[rows["status"] != "NOT_LOADED"]
    found: dict[str, Any] = {"all": counts(loaded), "not_loaded": len(rows) - len(loaded), "n_states": N_STATES}
    found["forms"] = {name: counts(loaded[loaded["group"] == name]) for name in N_FILES}
    found["subjects"] = {}
    for form, subject, names in ((name, *each) for name in N_FILES for each in TABLES[name].items()):
        has = [
            form == own and not names.keys().isdisjoint(str(text).split(", "))
            for own, text in zip(loaded["group"], loaded["features"], strict=True)
        ]
        found["subjects"][f"{form}: {subject}"] = counts(loaded[has])
    said = [part for text in loaded.loc[loaded["status"] == "SAID", "ignored"] for part in str(text).split("; ")]
    found["said"] = dict(Counter(said).most_common())
    found["refused"] = dict(Counter(map(reason, loaded.loc[loaded["status"] == "REFUSED", "message"])).most_common())
    found["silent"] = [f"{row['group']} {row['case']}" for _, row in loaded[loaded["status"] == "SILENT"].iterrows()]
    found["worst"] = float(loaded.loc[loaded["status"] == "AGREES", list(MEASURES)].to_numpy(float).max(initial=0.0))
    n, read = found["all"], len(loaded) - found["all"]["REFUSED"]
    found["answer"] = (
        f"Of {n['files']} files that MuJoCo loads, {read} are read; {n['AGREES']} agree to {power(TOLERANCE)}, "
        f"{n['SAID']} differ by what the reader names, {n['SILENT']} differ silently."
    )
    return found


STUDY = Study("models", __doc__, make, findings_of)

if __name__ == "__main__":
    STUDY.main()
