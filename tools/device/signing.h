/* Signed packets, version 2: link, time stamp and the first bytes of HMAC-SHA-256 follow the message. */
#ifndef SIGNING_H
#define SIGNING_H

#include "packet.h"

enum { KEY_BYTES = 32, TAG_BYTES = 6, STAMP_BYTES = 6, LINK_CAMERA = 1, LINK_MIRROR = 2, LINK_TO_HOST = 128 };

/* Time stamps count from 2015-01-01 00:00 UTC on. */
enum { STAMP_EPOCH_S = 1420070400, STAMPS_PER_S = 100000 };

struct signing {
    const uint8_t *key; /* KEY_BYTES; NULL where packets are not signed */
    uint8_t link;       /* of what comes; what goes has the other direction's */
    uint64_t sent;      /* the newest time stamp of each direction, in units of 10 microseconds since 2015; a device */
    uint64_t heard;     /* begins with `heard` at its clock, or at what it had heard before it was switched off */
};

/* Why a packet is not to be taken, NULL if it is. */
const char *signing_refusal(const struct signing *signing, const struct packet *packet);

/* Takes the signature off a packet that is not refused. */
void signing_take(struct signing *signing, struct packet *packet);

/* As packet_encode, with a signature where there is a key. */
size_t signing_encode(struct signing *signing, uint8_t *wire, uint8_t type, uint16_t sequence, const uint8_t *payload,
                      size_t size);

#endif
