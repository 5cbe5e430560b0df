"""Refining grasps and planning them by local search."""
