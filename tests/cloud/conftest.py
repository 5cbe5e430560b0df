from support.refining import coarse, filtered, make, valid  # noqa: F401
