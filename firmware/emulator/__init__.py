"""The firmware without a board: on this computer, and as the image on an emulated nRF52832.

``build`` and ``board_library`` compile it and call the portable files, ``processor/`` executes the image, and
``site/`` runs a whole site of boards with their hosts' programs in virtual time. A development tool: it is not part of
the package.
"""
