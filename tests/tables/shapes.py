"""The shapes that tests share: each model with one number of contacts, so that few programs are compiled.

A grasp of fewer contacts is padded with inactive ones. Compiling dominates a fast test and follows the shape
(model, contacts, dtype, options), not the data: about 3 s of CPU time for ``PLANAR``, 6 for ``HARD``, 8 for ``SOFT``.
"""

PLANAR = 3  # contacts of hard fingers in the plane
HARD = 4  # of hard fingers in space
SOFT = 6  # of soft fingers
