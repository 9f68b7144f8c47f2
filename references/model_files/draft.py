"""Draw random MJCF and URDF files, written as public files are, from templates and a table of features."""

import tomllib
from collections.abc import Callable
from pathlib import Path

import jinja2
import numpy as np

from twoloop.checks.arguments import Array

FOLDER = Path(__file__).parent
TABLES = tomllib.loads((FOLDER / "features.toml").read_text())
TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(FOLDER), undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
)
FREE = '<link name="world"/><joint name="free" type="floating"><parent link="world"/><child link="base"/></joint>'
TINY = '<compiler boundmass="1e-12" boundinertia="1e-12"/>'  # for MuJoCo, which has no massless bodies


def bodies(text: str) -> list[tuple[str, str]]:
    """Return the joints of each body of a skeleton, and the text of its children."""
    depth, start, found = 0, 0, []
    for k, letter in enumerate(text + ","):
        depth += (letter == "(") - (letter == ")")
        if letter == "," and not depth and text:
            joints, _, children = text[start:k].partition("(")
            found.append((joints.strip("n"), children[:-1]))
            start = k + 1
    return found


class Draft:
    """A random file, with the features that it used; the templates call its methods."""

    def __init__(self, form: str, kind: str, number: int):
        self.form, self.kind, self.rng = form, kind, np.random.default_rng([number, *f"{form} {kind}".encode()])
        shares = {name: share for features in TABLES[form].values() for name, share in features.items()}
        self.drawn = {name for name, share in shares.items() if self.rng.random() < share}
        self.skeleton, self.settings = (own := TABLES["kinds"][kind])[number % len(own)], TABLES["settings"]
        self.flat, self.separator = self.rng.random() < 0.3, self.one("_", "-", "/", ":")
        self.used, self.files, self.first = set[str](), dict[str, str](), dict[str, Array]()
        self.count, self.tips, self.sites, self.singles, self.balls = 0, [""], list[str](), list[str](), list[str]()
        self.radian = self.has("radian", 1.0)
        self.sequence = self.one("zyx", "XYZ", "ZYX", "zxz", "yzX") if self.has("eulerseq", 1.0) else "xyz"
        template = TEMPLATES.get_template(f"{form.lower()}.xml.j2")
        self.text = template.render(d=self, bodies=bodies).strip()
        self.free, tips = "floating base" in self.used, [tip for tip in self.tips if tip]
        known = "f" not in self.skeleton and not self.balls and not {"planar", "floating base"} & self.used
        self.loop = tips[:2] if form == "URDF" and known and len(tips) > 1 and self.has("loop", 1.0) else []

    def has(self, feature: str, share: float = 0.5) -> bool:
        """Draw whether an element has a feature that the file has."""
        drawn = feature in self.drawn and self.rng.random() < share
        self.used |= {feature} if drawn else set()
        return drawn

    def some(self, n: int, low: float = -0.4, high: float = 0.4) -> str:
        """Return random numbers."""
        return " ".join(f"{x:.5g}" for x in self.rng.uniform(low, high, n))

    def maybe(self, feature: str, low: float = 0.0, high: float = 0.0, n: int = 1) -> str:
        """Return an attribute with random numbers if an element has a feature, else nothing."""
        value = self.some(n, low, high) if high else "true"
        return f' {feature.split()[-1]}="{value}"' if self.has(feature) else ""

    def angle(self, n: int, most: float = 1.5) -> str:
        """Return random angles in the unit of the file."""
        unit = 1.0 if self.radian else 180.0 / np.pi
        return self.some(n, -most * unit, most * unit)

    def one(self, *choices: str) -> str:
        """Return one of several texts."""
        return str(self.rng.choice(np.array(choices, dtype=object)))

    def named(self, word: str) -> str:
        """Return a new name."""
        self.count += 1
        return f"{word}{self.separator}{self.count}a"  # replicas append digits

    def jointed(self, kind: str, body: str) -> str:
        """Return the name of a new joint."""
        as_body = body not in self.singles + self.balls and self.has("joint named as body", 0.3)
        name = body if as_body else self.named("joint")
        self.singles += [name] if kind in "hs" else []
        self.balls += [name] if kind == "b" else []
        return name

    def sited(self, tip: str) -> str:
        """Return the name of a new site; `tip`: the name of a body without children."""
        self.sites.append(self.named("site"))
        self.tips += [tip] if tip else []
        return self.sites[-1]

    def axis(self, kind: str, before: str = "") -> str:
        """Return the axis of a joint; those of one body differ."""
        number = before.count(kind)
        if not number or kind not in self.first:
            plain = {"s": "1 0 0", "h": "0 1 0"}.get(kind, "0 0 1")
            text = plain if self.flat else self.one("1 0 0", "0 1 0", "0 0 -1", self.some(3))
            self.first[kind] = np.array(text.split(), dtype=float)
        axis = np.roll(self.first[kind], -number) * (3.0 if self.has("axis of any length") else 1.0)
        return " ".join(f"{x:g}" for x in axis)

    def turn(self) -> str:
        """Return a random orientation, in one of MuJoCo's ways."""
        ways = {"quat": self.some(4), "axisangle": f"{self.some(3)} {self.angle(1)}", "euler": self.angle(3)}
        ways |= {"xyaxes": self.some(6), "zaxis": self.some(3)}
        way = self.one(*ways)
        if self.flat or self.rng.random() < 0.3:
            return ""
        self.used.add(way)
        return f' {way}="{ways[way]}"'

    def framed(self, replicable: bool = False, caller: Callable[[], str] = str) -> str:
        """Put elements into frames, a replicate or a file that is included, or leave them as they are."""
        text = caller()
        while self.has("frame", 0.2):
            text = f'<frame pos="{self.some(3)}"{self.turn()}>{text}</frame>'
        if replicable and self.has("replicate"):
            text = f'<replicate count="3" offset="{self.some(3)}" euler="{self.angle(3)}">{text}</replicate>'
        return self.apart(lambda: text) if replicable else text

    def apart(self, caller: Callable[[], str]) -> str:
        """Put elements into a file that is included, or leave them as they are."""
        if not self.has("include"):
            return caller()
        name = f"{self.named('part').replace('/', '-').replace(':', '-')}.xml"
        self.files[name] = f"<mujocoinclude>{caller()}</mujocoinclude>"
        return f'<include file="{name}"/>'

    def drawn_of(self, which: str, feature: str) -> list[list[str]]:
        """Return a pair of sites or joints, if the file has a feature."""
        names = getattr(self, which)
        return [list(self.rng.choice(names, 2, False))] if len(names) > 1 and self.has(feature, 1.0) else []

    def pairs(self) -> list[tuple[str, str]]:
        """Return attributes of equalities of random bodies and joints."""
        ends = self.rng.permutation(self.tips)[:2]
        drawn = {kind: ("body", sorted(ends)[::-1]) for kind in ("connect", "weld")}
        if len(self.singles) > 1:
            drawn["joint"] = "joint", list(self.rng.choice(self.singles, 2, False))
        numbered = ((kind, word, enumerate(names, 1)) for kind, (word, names) in drawn.items())
        return [(kind, " ".join(f'{word}{k}="{x}"' for k, x in names if x)) for kind, word, names in numbered]

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write the files; return the paths of the main one, and of that for MuJoCo, which has no massless bodies."""
        corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")[[0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]]
        faces = np.zeros(4, [("normal", "<3f4"), ("corners", "<9f4"), ("more", "<u2")])
        faces["corners"] = corners.reshape(4, 9)
        (folder / "meshes").mkdir()
        (folder / "meshes" / "part.stl").write_bytes(bytes(80) + np.uint32(4).tobytes() + faces.tobytes())
        for name, part in self.files.items():
            (folder / name).write_text(part)
        ending = "xml" if self.form == "MJCF" else "urdf"
        model, reference = (folder / f"{name}.{ending}" for name in ("model", "reference"))
        model.write_text(self.text)
        text = self.text
        for name in self.balls:  # in the other file these are types=
            text = text.replace(f'"{name}" type="fixed"', f'"{name}" type="spherical"')
        more = FREE if self.free else ""
        if self.used & {"massless body", "massless link"}:
            more += TINY if self.form == "MJCF" else f"<mujoco>{TINY}</mujoco>"
        end = text.rfind("</")
        reference.write_text(text[:end] + more + text[end:])
        return model, reference
