"""Floor 8: the playground, interactive cloth in the browser.

``scenes`` describes scenes, ``stage`` and ``episode`` run them for one visitor, ``page`` and ``controls`` say what their browser is
to show, ``server`` serves it with the files of ``web/``, and ``exporting`` writes pictures, films and meshes.
"""
