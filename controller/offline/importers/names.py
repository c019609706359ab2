"""What users name on the command line; imports nothing, so that help comes at once."""

from enum import StrEnum


class Program(StrEnum):
    """Whose files are read."""

    EASY_HANDEYE = "easy-handeye"
    MOVEIT = "moveit"
    ROBOT_CAL_TOOLS = "robot-cal-tools"


class Mounting(StrEnum):
    """Where the sensor is: on the arm, or beside it."""

    EYE_IN_HAND = "eye-in-hand"
    EYE_TO_HAND = "eye-to-hand"
