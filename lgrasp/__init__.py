"""lgrasp: a fast, trustworthy, open generator of dexterous-hand grasps."""

__version__ = "0.2.0"
__all__ = ["__version__"]
