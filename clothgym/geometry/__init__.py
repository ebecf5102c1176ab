"""Floor 1: triangles, segments and points, and nothing about contact.

``closest_points``: on triangles and segments.  ``intersections``: which triangles of a sheet intersect, decided exactly
(``filtered_predicates``, then ``exact_predicates``).  ``closed_mesh``: whether a mesh bounds a solid.
"""
