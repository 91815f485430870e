/* Packets of aolink/wire, version 1: COBS, CRC-32, sequence numbers, parts. Knows no message but Part. */
#ifndef PACKET_H
#define PACKET_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    PROTOCOL_VERSION = 1,
    MAX_PAYLOAD = 4608,                             /* bytes of the message in one packet */
    MAX_CHUNK = 4096,                               /* bytes of data in a FrameChunk, a TruthChunk or a Part */
    MAX_MESSAGE = 262144,                           /* bytes of a message in parts */
    HEADER_BYTES = 4,                               /* version, type, sequence */
    CRC_BYTES = 4,
    MAX_PACKET = HEADER_BYTES + MAX_PAYLOAD + CRC_BYTES,
    MAX_WIRE = MAX_PACKET + MAX_PACKET / 254 + 2    /* COBS adds a byte to each 254 and one; the delimiter */
};

struct packet {
    uint8_t version, type;
    uint16_t sequence;
    const uint8_t *payload; /* in the decoder's buffer, until its next byte */
    size_t size;
};

/* Begins with `crc` 0; the result of one piece is the `crc` of the next. */
uint32_t crc32(uint32_t crc, const uint8_t *bytes, size_t size);

/* Writes one packet and its delimiter; `wire` has room for MAX_WIRE bytes, `size` is at most MAX_PAYLOAD. Returns the
 * number of bytes. */
size_t packet_encode(uint8_t *wire, uint8_t type, uint16_t sequence, const uint8_t *payload, size_t size);

/* Takes COBS apart while the bytes come, so that it needs one buffer only. */
struct decoder {
    uint8_t bytes[MAX_PACKET];
    size_t size;
    uint8_t code, left; /* of the COBS run: its first byte, and how many bytes of it are to come */
    bool broken;        /* too long: everything up to the next delimiter is skipped */
    uint32_t bad_crc, bad_framing;
};

/* True when `byte` ends a packet whose CRC is right. All zeros is a decoder at its beginning. */
bool decoder_take(struct decoder *decoder, uint8_t byte, struct packet *packet);

/* Which sequence numbers have come: the newest, and a bit for each of the 64 before it. */
struct window {
    uint64_t seen;
    uint16_t newest;
    bool begun;
    uint32_t lost, duplicates;
};

/* False for a duplicate. */
bool window_take(struct window *window, uint16_t sequence);

/* Puts a message in parts together. */
struct parts {
    uint8_t *bytes; /* the caller's buffer, of the longest message that it wants */
    size_t room, size, total;
    uint16_t sequence; /* of the newest part */
    uint8_t type;      /* 0: no message has begun */
    uint32_t refused;
};

/* True when `packet` is the last part, or no part at all: it is then the whole message. */
bool parts_take(struct parts *parts, struct packet *packet);

#endif
