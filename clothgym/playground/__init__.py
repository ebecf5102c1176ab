"""Floor 8: the playground, interactive cloth in the browser.

``scenes`` describes scenes, ``stage`` and ``episode`` run them for one visitor, ``page`` makes the controls, only ``server``
imports viser, and ``exporting`` writes pictures, films and meshes.
"""
