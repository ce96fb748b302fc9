"""A site: anchors, schedule, noise figures, floor plan and georeference, from one TOML file."""
