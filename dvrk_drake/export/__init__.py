"""Identified models as files of other programs: SDF, URDF, the dVRK's gravity compensation, C, Python, LaTeX."""
