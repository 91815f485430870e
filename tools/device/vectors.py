"""Write aolink/wire/vectors.json as C tables, and the schema's hash, to standard output: vectors.py VECTORS PROTO."""

import hashlib
import json
import re
import sys
from pathlib import Path


def array(text: str) -> str:
    data = bytes.fromhex(text)
    return f"{{(const uint8_t[]){{{','.join(map(str, data or b'0'))}}}, {len(data)}}}"


vectors = json.loads(Path(sys.argv[1]).read_text())
schema = re.sub(r"\s", "", re.sub(r"//[^\n]*", "", Path(sys.argv[2]).read_text()))
print("/* Made by vectors.py. */")
print("static const struct good good[] = {")
for vector in vectors["good"]:
    head = f'"{vector["what"]}", {vector["version"]}, {vector["type"]}, {vector["sequence"]}'
    print(f"    {{{head}, {array(vector['payload'])}, {array(vector['wire'])}}},")
print("};\n#ifndef GOOD_ONLY")
print(f"static const struct bytes schema_hash = {array(hashlib.sha256(schema.encode()).hexdigest()[:16])};")
print("static const struct broken broken[] = {")
for vector in vectors["broken"]:
    head = f'"{vector["what"]}", {array(vector["wire"])}'
    print(f"    {{{head}, {vector['bad_crc']}, {vector['bad_framing']}}},")
print("};\nstatic const struct in_parts in_parts[] = {")
for vector in vectors["parts"]:
    assert len(vector["messages"]) <= 1
    kind, payload = vector["messages"][0] if vector["messages"] else (0, "")
    head = f'"{vector["what"]}", {array(vector["wire"])}'
    print(f"    {{{head}, {kind}, {array(payload)}, {vector['refused']}}},")
print("};\n#endif")
