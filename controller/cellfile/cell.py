"""The cell file as a whole, in SI units."""

import hashlib
import json
from datetime import date
from pathlib import Path

from pydantic import Field, PrivateAttr

from controller.cellfile.job import Job
from controller.cellfile.lasers import AnyLaser
from controller.cellfile.lines import KeyPath, LineIndex
from controller.cellfile.mistakes import Mistake, Source
from controller.cellfile.objects import Artefact, Bar, Part, Plate, Sphere
from controller.cellfile.probes import AnyProbe
from controller.cellfile.robots import Robot
from controller.cellfile.tables import Name, Placement, Table


class Header(Table):
    """The cell itself."""

    name: Name
    """Name of the cell."""
    simulated: bool = False
    """Whether simulators stand in for the devices: every result then says so."""
    patience: float = Field(default=1.0, ge=1.0, le=100.0)
    """Watches over links wait so many times longer; above 1 only for simulated devices on a busy computer."""


class Cell(Table):
    """A cell file that was read and checked."""

    cell: Header
    """The cell itself."""
    robot: Robot
    """The arm."""
    laser: AnyLaser
    """The distance laser."""
    probe: AnyProbe
    """The touch probe."""
    plate: Plate
    """The calibration plate."""
    bar: Bar
    """The two-sphere bar."""
    sphere: Sphere
    """The sphere for the stylus."""
    part: Part
    """The part."""
    job: Job
    """The job."""

    _path: Path = PrivateAttr(default=Path("cell.toml"))
    _source: Source = PrivateAttr(default=Source("cell.toml", "", LineIndex(), {}))
    _cad_digest: str = PrivateAttr(default="")

    @property
    def name(self) -> str:
        """Name of the cell."""
        return self.cell.name

    @property
    def simulated(self) -> bool:
        """Whether every result must be marked as simulated."""
        return self.cell.simulated

    @property
    def path(self) -> Path:
        """The cell file, absolute."""
        return self._path

    @property
    def directory(self) -> Path:
        """The folder of the cell file, absolute."""
        return self._path.parent

    @property
    def text(self) -> str:
        """The cell file as it was read."""
        return self._source.text

    @property
    def cache_dir(self) -> Path:
        """Folder for what can be computed again from the files of the cell; it may not exist yet."""
        return self.directory / ".truecell"

    @property
    def cad_path(self) -> Path:
        """The CAD file of the part, absolute."""
        return self.directory / self.part.cad

    @property
    def placements(self) -> tuple[Placement, ...]:
        """All placed frames: laser, probe, plate, bar, sphere, part."""
        return (self.laser.mount, self.probe.mount, self.plate, self.bar, self.sphere, self.part)

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of all values in SI units and of the CAD file.

        Comments, layout and the choice of units do not change it; values and the CAD file do.
        """
        content = self.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        canonical = json.dumps([content, self._cad_digest], sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()

    def expired(self, today: date) -> list[str]:
        """Certificates that no longer hold today, in words."""
        artefacts: tuple[Artefact, ...] = (self.plate, self.bar, self.sphere)
        return [
            f"certificate {artefact.certificate or 'without number'} of the {artefact.FRAME} "
            f"held until {artefact.valid_to}"
            for artefact in artefacts
            if artefact.valid_to is not None and artefact.valid_to < today
        ]

    def differences(self, other: "Cell") -> list[str]:
        """What `other` says differently, one line for each value: "robot.readings: 3 -> 5"."""
        mine, theirs = (_flat("", cell._source.data) for cell in (self, other))
        lines = [
            f"{key}: {mine.get(key, 'not there')} -> {theirs.get(key, 'not there')}"
            for key in [*mine, *(key for key in theirs if key not in mine)]
            if mine.get(key) != theirs.get(key)
        ]
        if self._cad_digest != other._cad_digest and self.part.cad == other.part.cad:
            lines.append(f"part.cad: the content of {self.part.cad} changed")
        return lines

    def mistake_at(self, path: KeyPath, problem: str, remedy: str = "") -> Mistake:
        """A mistake found after loading, at a key such as ("job", "phases", 2, "limit")."""
        return self._source.mistake(path, problem, remedy)


def _flat(prefix: str, value: object) -> dict[str, str]:
    if isinstance(value, dict):
        items = [(f"{prefix}.{key}" if prefix else str(key), child) for key, child in value.items()]
    elif isinstance(value, (list, tuple)) and any(isinstance(child, dict) for child in value):
        items = [(f"{prefix}[{position}]", child) for position, child in enumerate(value, start=1)]
    else:
        return {prefix: json.dumps(value, default=str, ensure_ascii=False)}
    return {key: text for name, child in items for key, text in _flat(name, child).items()}
