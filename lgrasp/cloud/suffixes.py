"""Suffixes of the files that point clouds and masks are read from."""

CLOUD_SUFFIXES = (".ply", ".xyz", ".npy", ".npz", ".h5")
MASK_SUFFIXES = (".npy", ".npz")
