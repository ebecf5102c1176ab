"""Floor 8: the playground, cloth to play with in the browser.

``scenes`` and ``world`` describe what is shown, ``stage`` and ``episode`` run it for one visitor, ``page`` and ``server`` alone use
viser, and ``exporting`` and ``files`` write what was shown.
"""
