"""Several meshes as one."""

import trimesh


def joined_mesh(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Several meshes as one."""
    whole = trimesh.util.concatenate(meshes)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def outer_mesh(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """The surface of the union of solids, without what one covers of another; all of it where they are no solids."""
    if len(meshes) > 1 and all(mesh.is_volume for mesh in meshes):
        whole = trimesh.boolean.union(meshes, engine="manifold")
        if whole.is_volume:
            return whole
    return joined_mesh(meshes)
