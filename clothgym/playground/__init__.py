"""Floor 8: the playground, cloth that a visitor can touch in the browser.

``scenes`` is what is shown, ``stage`` one visitor's cloth, and ``page`` and ``server`` are all that knows of viser.
"""
