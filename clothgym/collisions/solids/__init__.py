"""Contact of sheets with solids.

``owner``: the colliders of a batch.  ``shapes``, ``mesh_collider``: as people describe them.  ``signed_distance``,
``distance_grid``: as kernels measure them.  ``contact_law``: what a contact does.  Where it happens: ``particle_contact``,
``triangle_contact`` (at the ``deepest_point``), ``attachment_contact`` (anchors and grippers).
``penetration``: how deep a sheet is.
"""
