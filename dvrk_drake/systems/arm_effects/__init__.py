"""Effects of a simulated arm besides links, joints and linkage. Parts of `ArmStation`; see `models.effects_schema`."""
