"""Export of identified models to SDF, URDF, gravity-compensation files of the dVRK, C, Python and LaTeX."""
