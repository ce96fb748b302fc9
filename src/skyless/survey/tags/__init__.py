"""What a tag's receptions add to a survey: constants at known positions, and a tag that is carried around.

``estimate`` is the regression at known positions alone; ``epochs`` averages differences, ``walk`` makes rows of them,
``joint`` fits them together with the ranges.

Public: epochs, estimate, joint.
"""
