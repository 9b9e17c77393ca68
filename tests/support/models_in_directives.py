"""Drake model directives for tests."""

#: A right master beside the arm, at its home pose. The argument x is the distance of the bases [m].
OTHER_ARM = """
directives:
- add_model:
    name: other
    file: package://dvrk_drake/sdf/mtmr.sdf
- add_weld:
    parent: world
    child: other::base_link
    X_PC:
      translation: [{x}, 0.0, 0.0]
"""
