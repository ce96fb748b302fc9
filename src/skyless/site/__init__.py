"""A site: anchors, schedule, noise figures, floor plan and georeference, from one TOML file.

Public: advice, almanac_pages, check, georeference, grid, image, lab, load, model, near, rewrite,
slot_colours, slots, template.
"""
