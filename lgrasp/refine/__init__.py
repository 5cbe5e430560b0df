"""Differentiable local search of grasps."""
