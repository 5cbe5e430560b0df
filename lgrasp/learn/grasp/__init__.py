"""One-object predictor: grasps from a cloud, drawn by a diffusion model on what a second network completes of it."""
