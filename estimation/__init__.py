"""Pure mathematics of the cell: arrays in, frozen results out."""
