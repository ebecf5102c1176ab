"""Floor 1: triangles, segments and points, and nothing about contact.

``closest_points``: of triangles and segments; ``intersections``: how many triangles of a sheet intersect, decided exactly
(``exact_predicates``); ``closed_mesh``: whether triangles bound a solid.
"""
