"""The command line: parse, call one function, print."""

import os

# Matrices here are small, many and multiplied in turn with threads of our own: threads of the
# linear algebra cost more than they give, and how many there are would change the last digits.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
