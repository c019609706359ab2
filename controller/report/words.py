"""The report's fixed words: names of phases and quantities, how to read it, and what it does not claim."""

from datetime import UTC, datetime
from typing import Final

PURPOSE: Final = {
    "noise": "Repeatability of joints and sensors",
    "hand_eye": "Hand-eye calibration",
    "check": "Independent check",
    "localize": "Localization of the part",
    "inspect": "Inspection",
    "kinematics": "Kinematic calibration",
}

BLOCKS: Final = {
    "laser": "Laser on the flange",
    "laser.scale": "Laser reading",
    "laser.offset": "Laser reading",
    "plate": "Plate in the base",
    "bar": "Sphere bar in the base",
    "kinematics": "Kinematic deviations",
    "part": "Part in the base",
    "probe": "Stylus on the flange",
    "probe.radius": "Stylus on the flange",
    "sphere": "Stylus sphere in the base",
}

FREEDOMS: Final = {
    "tx": "x",
    "ty": "y",
    "tz": "z",
    "shift_x": "shift x",
    "shift_y": "shift y",
    "shift_z": "shift z",
    "tilt_x": "tilt x",
    "tilt_y": "tilt y",
    "tilt_z": "tilt z",
    "offset": "offset",
}

READING_NOTES: Final = (
    "u is a standard uncertainty, U = k u an expanded one: k = 2 for single values. At gated points U is "
    "the longest half axis of the 95 % ellipsoid, k = 2.80 in three dimensions.",
    "u is rounded to two digits and its value to the same place, for display only; decisions use full "
    "precision.",
    "OK and NotOK are proven. NotDecidable means that neither could be claimed within the stated "
    "uncertainty; Undefined means that nothing was measured that could decide.",
)

POSE_NOTE: Final = (
    "Poses: position, and fixed-axis angles about x, y, z. Their u is that of a small movement along or "
    "about the axes of the object's own frame. Deviations are from the nominal value."
)

DISCLAIMERS: Final = (
    "It covers the listed characteristics of the measured part at the time of measurement only. It says "
    "nothing about other characteristics, other parts, or later times.",
    "It is not a certificate of conformity or calibration, and claims no compliance with or certification "
    "to any standard. Decision rules and tests follow the method of the standards they name.",
    "Uncertainties rest on the models and noise levels declared in the cell file and on the certificates of "
    "the artefacts; truecell tests them for consistency but cannot replace those certificates.",
    "truecell performs no safety function. Nothing in this report may be used to judge the safety "
    "of the cell.",
)

SIMULATED: Final = "Simulated run: every reading came from a simulated cell. No physical part was measured."
SIMULATED_DISCLAIMER: Final = (
    "All measurements are simulated. No statement about any physical robot, sensor or part follows from them."
)


def utc(utc_s: float) -> str:
    """A moment, to the second."""
    return datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def lasting(duration_s: float) -> str:
    """A duration in the two units that matter."""
    seconds = max(0, round(duration_s))
    hours, minutes = seconds // 3600, seconds // 60 % 60
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {seconds % 60:02d} s" if minutes else f"{seconds} s"


def counted(count: int, one: str, many: str = "") -> str:
    """ "1 phase", "3 phases"."""
    return f"{count} {one if count == 1 else many or one + 's'}"


def sentence(text: str) -> str:
    """With a capital in front and a full stop behind."""
    text = text.strip()
    if not text:
        return ""
    return text[0].upper() + text[1:] + ("" if text[-1] in ".!?" else ".")
