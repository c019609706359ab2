"""Files of other programs as data sets: form, units and directions are written down, nothing is guessed."""
