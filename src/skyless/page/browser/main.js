/** Puts the page together. */

import { on, state } from "./store.js";
import { dropToken } from "./api.js";
import * as alarmLine from "./alarm_line.js";
import * as banner from "./banner.js";
import * as legend from "./legend.js";
import * as live from "./live.js";
import * as map from "./map/map.js";
import * as placing from "./map/placing.js";
import * as partNote from "./part_note.js";
import * as playerBar from "./player_bar.js";
import * as sites from "./sites.js";
import * as summary from "./summary.js";
import * as tabs from "./tabs.js";
import * as theme from "./theme.js";
import * as tools from "./map/tools.js";
import { live as liveTracks, replayed, shown_s } from "./clock.js";
import { byId, text } from "./dom.js";

dropToken();
theme.start();
map.start();
tools.start();
placing.start();
legend.start();
tabs.start();
playerBar.start();
banner.start();
alarmLine.start();
partNote.start();
sites.start();
summary.start();
on(["site"], () => {
  text(byId("site-name"), state.site?.name ?? "");
  byId("site-name").title = state.site ? `Site ${state.site.id}, ${state.site.name}` : "";
  byId("simulated").hidden = !state.simulated;
});
live.start();

/** For tests and the console; the page itself does not use it. */
window.skyless = { state, live: liveTracks, replayed, shown_s, frames: map.drawnFrames };
