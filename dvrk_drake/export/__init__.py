"""Export of identified models to SDF, URDF, the dVRK's gravity compensation, C, Python and LaTeX."""
