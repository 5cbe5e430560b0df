"""Sequential multi-object grasps: the job that makes shards of them."""
