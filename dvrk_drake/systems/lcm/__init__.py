"""The systems that talk LCM, both ends of an arm's channels; as pydrake.systems.lcm is to Drake's systems."""
