# Bytes of stack on the deepest path from reset_handler, by the call graphs (gcc -fcallgraph-info=su) of an image:
#   awk -f stack.awk source/main.c FILE.ci ...
# Refused are recursion, frames that grow at run time, and calls through pointers but those of struct hardware, which
# count as the deepest of the functions in HARDWARE of main.c. libgcc's have no call graph; LIBRARY allows for each.
BEGIN { FS = "\""; LIBRARY = 96 }

FILENAME ~ /main\.c$/ {
    if (match($0, /^ +\.[a-z0-9_]+ = [a-z0-9_]+,$/)) {
        sub(/.*= /, ""); sub(/,/, "")
        calls["*"] = calls["*"] " " $0
    }
    next
}

/^node/ && match($4, /[0-9]+ bytes \(/) {
    name = short($2)
    bytes[name] = substr($4, RSTART) + 0
    is_fixed[name] = $4 ~ /bytes \(static\)/
}

/^edge/ {
    name = short($4)
    if (name == "__indirect_call") {
        split($6, place, ":")
        for (line = 0; line < place[2] && (getline text < place[1]) > 0; line++) { }
        close(place[1])
        if (substr(text, place[3]) !~ /^([a-z]+->)*(hardware->[a-z0-9_]+|writer->write_line)\(/) {
            refuse(short($2) " calls through a pointer: " $6)
        }
        name = "*"
    }
    calls[short($2)] = calls[short($2)] " " name
}

END { if (!is_refused) print deepest("reset_handler") }

# Static functions are file:function, and those of HARDWARE are static in main.c or known to all.
function short(title) { sub(/^.*main\.c:/, "", title); return title }

function refuse(why) { print "stack: " why > "/dev/stderr"; is_refused = 1; exit 1 }

function deepest(name, callees, count, at, most, one) {
    if (name in known) return known[name]
    if (name in above) refuse(name " calls itself")
    if (!(name in bytes) && name ~ /^__aeabi_/) return LIBRARY
    if (name != "*" && !(name in bytes)) refuse(name " has no frame that is known")
    if (name != "*" && !is_fixed[name]) refuse(name " has a frame that grows")
    above[name]
    count = split(calls[name], callees, " ")
    for (at = 1; at <= count; at++) if ((one = deepest(callees[at])) > most) most = one
    delete above[name]
    return known[name] = bytes[name] + most
}
