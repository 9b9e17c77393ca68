"""What a simulated arm has beside links, joints and a linkage: parts of `ArmStation`, see `models.effects_schema`."""
