"""``lgrasp dataset report``: the contents of a data set, as one HTML page and as numbers."""

from lgrasp.dataset.report.write import read_dataset, report_dataset

__all__ = ["read_dataset", "report_dataset"]
