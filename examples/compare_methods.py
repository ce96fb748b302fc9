"""All positioning methods on the same air: one tag at rest, one that walks, a twentieth of the messages lost."""

import skyless

WALK = ((1.0, 1.0), (5.0, 1.0), (5.0, 7.0), (1.0, 1.0))

print("method           at rest  walking   RMSE in cm, simulated")
for method in skyless.METHODS:
    at_rest = skyless.simulate(method=method, positions_m=[(2.0, 3.0)], loss=0.05, duration_s=4.0, seed=3)
    walking = skyless.simulate(method=method, paths_m=[WALK], loss=0.05, duration_s=4.0, seed=3)
    errors_cm = [100 * result.report.rmse_m for result in (at_rest, walking)]
    print(f"{method:<16} {errors_cm[0]:7.1f}  {errors_cm[1]:7.1f}")
