"""What a real arm has beside links, joints and a linkage: parts of `ArmStation` that `models.effects_schema` describes."""
