"""Grasp shards: the file format, its writer, readers, validator, merge and torch Dataset."""
