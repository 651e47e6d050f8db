"""The HDF5 report: written complete or not at all, read back by version."""
