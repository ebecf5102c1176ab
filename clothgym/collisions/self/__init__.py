"""Contact of a sheet with itself.

``owner``: options, memory and report of a batch.  ``step``: the order of the work after a substep, and the guarantee.
``topology``: which pairs there are.  ``spread``: whether any can be close.  ``broad_phase``, ``narrow_phase``: which are close, and
how far each vertex may move.
``impulses``: what pushes layers apart.  ``displacement_bounds``, ``gap_constraints``: what keeps them from passing through.
"""
