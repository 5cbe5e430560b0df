"""What a mesh file consists of: its own bytes, and the buffers in other files that a .gltf names."""

import base64
import hashlib
import json
from pathlib import Path
from urllib.parse import unquote

_LFS_POINTER = b"version https://git-lfs"
_STL_TEXT = 1000  # bytes in which the first face of a text begins


def check_whole(kind: str, data: bytes) -> None:
    """Refuse bytes that a parser would take for an empty mesh.

    Raises:
        ValueError: they only name a file of Git LFS, or are not all of a binary STL, or more.
    """
    if data.startswith(_LFS_POINTER):
        raise ValueError("a pointer of Git LFS, not the mesh itself; git lfs pull fetches it")
    if kind == "stl" and b"facet" not in data[:_STL_TEXT]:
        faces = int.from_bytes(data[80:84], "little")
        if len(data) != 84 + 50 * faces:
            raise ValueError(
                f"no whole STL: {len(data):,} bytes; of a binary one with {faces:,} faces, "
                f"{84 + 50 * faces:,} are accepted"
            )


def mesh_bytes(path: Path, data: bytes | None = None) -> dict[str, bytes]:
    """All bytes that make a mesh, by name: "" for the file itself, else the URI of a buffer.

    Textures and materials are left out: they change no shape.

    Args:
        data: the file's own bytes, if they were read already.

    Raises:
        OSError: a file cannot be read, or lies outside the mesh's folder.
    """
    data = path.read_bytes() if data is None else data
    found = {"": data}
    if path.suffix.lower() == ".gltf":
        for uri in _buffers(data):
            found[uri] = _inside(path.parent, uri).read_bytes()
    return found


def mesh_digest(files: dict[str, bytes]) -> str:
    """SHA-256 of what :func:`mesh_bytes` gave: of the file itself where it is alone, 64 hex digits."""
    whole = hashlib.sha256(files[""])
    for name in sorted(files.keys() - {""}):
        whole.update(f"\n{name}\n{hashlib.sha256(files[name]).hexdigest()}".encode())
    return whole.hexdigest()


def one_file(path: Path) -> bytes:
    """A mesh as one file: the buffers of a .gltf are in it.

    Raises:
        OSError: as of :func:`mesh_bytes`.
    """
    found = mesh_bytes(path)
    if len(found) == 1:
        return found[""]
    whole = json.loads(found[""])
    for buffer in whole["buffers"]:
        if (uri := buffer.get("uri")) in found:
            buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(found[uri]).decode()
    return json.dumps(whole).encode()


def _buffers(data: bytes) -> list[str]:
    """URIs of the buffers of a glTF that are files; none of what is no glTF, which its parser reports better."""
    try:
        uris = {str(buffer["uri"]) for buffer in json.loads(data)["buffers"] if "uri" in buffer}
    except (ValueError, KeyError, TypeError, RecursionError):
        return []
    return sorted(uri for uri in uris if not uri.startswith("data:"))


def _inside(folder: Path, uri: str) -> Path:
    """The regular file that a URI names below a folder."""
    for name in (uri, unquote(uri)):
        path = (folder / name).resolve()
        if path.is_relative_to(folder.resolve()) and path.is_file():
            return path
    raise FileNotFoundError(2, "no such file in the folder of the .gltf", uri[:200])
