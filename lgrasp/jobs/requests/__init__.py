"""What can be asked of each job. Nothing here loads hands, meshes or devices: what cannot be is told at once."""
