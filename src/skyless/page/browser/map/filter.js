/** The filter of the list of tags, by group, zone and search; the map dims what it leaves out. */

import { state } from "../store.js";
import { isFound } from "../assets/model.js";
import { X, Y } from "../tracks.js";
import { inside } from "./zones.js";

/** Whether any tag may be left out. */
export function filtering() {
  return Boolean(state.find || state.filter.group || zoneOfFilter());
}

/** Whether the filter leaves a tag, whose state is in `row`. */
export function passes(tag, row) {
  const zone = zoneOfFilter();
  return isFound(tag) && (!zone || inside(zone.polygon_m, row[X], row[Y]));
}

/** The chosen zone, as long as there is one. */
function zoneOfFilter() {
  return state.filter.zone ? state.zones.find(({ id }) => id === state.filter.zone) : undefined;
}
