"""Where an object is: search over all poses, refinement on free forms, streams of stripes."""
