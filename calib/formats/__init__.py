"""Rigs in files, ours and those of other programs, one format a module, read and written."""
