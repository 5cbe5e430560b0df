"""The independent judge: imports nothing else of lgrasp and derives every strict bound from URDF and meshes alone."""
