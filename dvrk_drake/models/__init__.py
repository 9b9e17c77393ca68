"""Models of arms: SDF files, YAML schemas, Drake plant, limits, loop closures and LCM message layout."""
