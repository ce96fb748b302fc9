"""Planning: what a site will give before anything is mounted, and where its anchors should hang.

Public: advice, colours, columns, floor, links, maps, optimise, page, picture, predict, reception, report, slot_picture,
slot_plan, slot_report, verify.
Within the package: anchor_clocks, joint_sigma, snapshot_sigma, tag_rates.
"""
