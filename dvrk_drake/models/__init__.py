"""Description of an arm: SDF, YAML schemas, plant, limits, loop closures, and the layout of its LCM messages."""
