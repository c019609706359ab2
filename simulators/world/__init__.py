"""The simulated world: arm with errors, part, artefacts, and what a beam or a stylus meets there."""
