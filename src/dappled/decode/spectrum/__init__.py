"""From a raw plane to its spectrum, its carriers and its slices."""
