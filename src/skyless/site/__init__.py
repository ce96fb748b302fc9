"""A site: anchors, schedule, noise figures, floor plan and georeference, from one TOML file.

Public: advice, almanac_pages, check, free_access, georeference, image, lab, load, model, rewrite, slots, template.
"""
