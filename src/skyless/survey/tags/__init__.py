"""What a tag's receptions add to a survey: constants at known positions, and a tag that is carried around.

``estimate`` is the regression at known positions alone. ``relayed`` makes differences of receptions, ``epochs`` means
of them, ``walk`` makes rows of these, and ``joint`` fits these together with the anchors' ranges.

Public: epochs, estimate, joint, received, relayed.
"""
