"""The first fix: a tag at (3, 4) m in the lab, simulated, and what is known of its position."""

from skyless import Request, fleet_of, lab_site

fleet = fleet_of(Request(site=lab_site(), positions_m=((3.0, 4.0),), seed=7))
for judged in fleet.run(until_s=3.0):
    fix = judged.fix
print(fix.position_m, fix.std_m, fix.dops.hdop, judged.error_m)
