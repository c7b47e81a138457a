"""Two checkouts, the same scenes, and whether a number moved: `python -m tests.reference BEFORE AFTER`.

`cases` says what is run, `checkout` runs it with one checkout, and `comparison` says what differs. Nothing here imports
ommatid: the insides of the two checkouts may differ in everything but command line, run.json and the exported H.
"""
