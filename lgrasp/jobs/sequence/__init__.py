"""Sequential multi-object grasps: the job that makes shards of them."""

__all__: list[str] = []
