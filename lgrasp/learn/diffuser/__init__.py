"""SeqDiffuser: poses and joints for the next object of a hand that holds others, drawn by a diffusion model."""
