"""A gravity compensation in the formats of others, compared with theirs."""
