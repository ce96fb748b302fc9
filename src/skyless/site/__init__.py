"""A site: anchors, schedule, noise figures, floor plan and georeference, from one TOML file.

Public: advice, almanac_pages, check, digest, earth, free_access, georeference, grid, image, lab, load, local_almanac,
model, near, outline, rewrite, slot_colours, slots, template.
"""
