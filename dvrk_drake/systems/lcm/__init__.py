"""Systems for both ends of an arm's LCM channels, as pydrake.systems.lcm contains Drake's LCM systems."""
