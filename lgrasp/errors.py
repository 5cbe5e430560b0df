"""One exception tree. Every message is one line that states the value, its file and what would be accepted."""


def short_reason(error: BaseException, most: int = 200) -> str:
    """What an error says, on one line of so many characters; its kind where it says nothing."""
    return " ".join(str(error).split())[:most] or type(error).__name__


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error of Python or of a library is that no memory was left, of the computer or of a GPU."""
    words = str(error).lower()
    return isinstance(error, MemoryError) or "out of memory" in words or "failed to allocate" in words


class LgraspError(Exception):
    """Base of every error that lgrasp raises on purpose; the command line prints it on one line and exits."""

    exit_code = 2


class HandError(LgraspError):
    """A hand (URDF, hand.yaml or name) cannot be used."""


class ObjectError(LgraspError):
    """An object mesh (file, scale or name) cannot be used."""


class CloudError(LgraspError):
    """A point cloud, its mask or its viewpoint cannot be used."""


class DecomposeError(LgraspError):
    """A mesh could not be cut into convex pieces; callers use its hull instead."""


class ConfigError(LgraspError):
    """A pipeline, job config or option holds a wrong key or value."""


class DeviceError(LgraspError):
    """The compute device does not exist or is out of memory."""


class OutputError(LgraspError):
    """An output file or folder cannot be written, or belongs to another run."""


class ShardError(LgraspError):
    """A shard is truncated, corrupted or violates the format."""


class PhysicsError(LgraspError):
    """A simulator is missing, or refuses the scene."""


class CacheError(LgraspError):
    """The cache folder cannot be used."""


class StarvedError(LgraspError):
    """Fewer grasps than requested were found after a bounded effort; those found are kept."""

    exit_code = 3
