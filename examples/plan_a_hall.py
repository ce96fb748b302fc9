"""A hall before anything is mounted: what six anchors would give, and what eight placed by the planner would.

Picture: ``python plan_a_hall.py hall.png``.
"""

import sys

import skyless
from skyless.site.file.template import rectangular_site

hall = rectangular_site(24.0, 14.0, 6, 5.0, 1.2)  # width, depth, anchors, their greatest height; tags 1.2 m high
now = skyless.plan(hall, step_m=2.0, target_m=0.1)
better = skyless.plan(hall, step_m=2.0, target_m=0.1, optimise=8, search_s=2.0)

for name, result in (("six anchors", now), ("eight, placed", better)):
    found = result.summary
    print(f"{name}: mean {100 * found['mean_sigma_m']:.1f} cm, worst {100 * found['worst_sigma_m']:.1f} cm, "
          f"10 cm or better in {found['target_share']:.0%} of the hall")  # fmt: skip
print("anchors at:", ", ".join(f"({one.x_m:g}, {one.y_m:g}, {one.z_m:g})" for one in better.site.anchors))
if len(sys.argv) > 1:
    better.plot().savefig(sys.argv[1])
