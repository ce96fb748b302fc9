#!/bin/bash
# Makes authentication_vectors.json with standard tools alone (openssl, xxd): an implementation of docs/authentication.md
# that shares no line with Skyless. tests/core/test_vectors.py compares. Takes a minute.
set -euo pipefail
cd "$(dirname "$0")"

bytes() { xxd -r -p; }
hex() { xxd -p | tr -d '\n'; }
ascii() { printf '%s' "$1" | hex; }
le16() { printf '%02x%02x' $(($1 & 255)) $(($1 >> 8 & 255)); }
le32() { le16 $(($1 & 65535)); le16 $(($1 >> 16)); }
le40() { le32 $(($1 & 4294967295)); printf '%02x' $(($1 >> 32)); }
sha256() { printf '%s' "$1" | bytes | openssl dgst -sha256 -binary | hex; }
hmac() { printf '%s' "$2" | bytes | openssl dgst -sha256 -mac HMAC -macopt "hexkey:$1" -binary | hex; }

site=42 serial=3 interval_ms=100 lag=5
section=2197265                          # it begins on 2027-01-15
first=$(((section - 1) << 13 | 77))      # the chain began within the section before
interval=$((section << 13 | 8189))       # the third but last of the section
seed=000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f
private=f0e1d2c3b4a5968778695a4b3c2d1e0f00112233445566778899aabbccddeeff
name=$(le16 $site)$(le16 $serial)$(le32 $section)

last_key=$(hmac $seed "$(ascii 'skyless seed')$name" | cut -c1-32)
key=$last_key
label=$(ascii 'skyless key')$name
for ((step = 1; step <= 8192; step++)); do
  key=$(sha256 "$label$key" | cut -c1-32)
  [ $step -eq 2 ] && interval_key=$key
done
root=$key
mac_key=$(sha256 "$(ascii 'skyless mac')$name$interval_key" | cut -c1-32)

# The beacon of docs/protocol2.md with flag 0x04, and after it the interval.
beacon=4188392a00ffff2c0153b207a4420330a719771efcc402735bffa00f0014ff0722002b010c60450328a74b01c85e470318a7
beacon+=060400000000000001b004000000000000
signed=$beacon$(le16 $((interval & 65535)))
mac=$(hmac "$mac_key" "$signed" | cut -c1-16)

statement=$(le16 $serial)$(le40 $first)$(le32 $section)$(le16 $interval_ms)$(printf %02x $lag)$root
covered=$(ascii 'skyless chain')$(le16 $site)$statement
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
printf '302e020100300506032b657004220420%s' $private | bytes > "$scratch/private.der"   # RFC 8410
printf '%s' "$covered" | bytes > "$scratch/covered"
public=$(openssl pkey -inform DER -in "$scratch/private.der" -pubout -outform DER | tail -c 32 | hex)
signature=$(openssl pkeyutl -sign -rawin -inkey "$scratch/private.der" -keyform DER -in "$scratch/covered" | hex)

cat > authentication_vectors.json <<END
{
  "site": $site,
  "serial": $serial,
  "section": $section,
  "first": $first,
  "interval_ms": $interval_ms,
  "lag": $lag,
  "seed": "$seed",
  "last_key": "$last_key",
  "root": "$root",
  "interval": $interval,
  "interval_key": "$interval_key",
  "mac_key": "$mac_key",
  "signed_bytes": "$signed",
  "mac": "$mac",
  "private_key": "$private",
  "public_key": "$public",
  "certificate": "$statement$signature"
}
END
