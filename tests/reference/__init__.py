"""Float64 NumPy restatement of the bead-chain physics: slow, clear, independent of the package.

Every formula is written from its source a second time, so that a test compares two codings and not
one coding with itself. Nothing here imports the package under test. Arguments carry no hidden
units: pass a = eta = rate = 1 or SI numbers.
"""
