#include "signing.h"

#include <string.h>

enum { BLOCK_BYTES = 64, HASH_BYTES = 32 };

struct sha256 {
    uint32_t state[8];
    uint8_t block[BLOCK_BYTES];
    uint64_t size; /* bytes so far */
};

static uint32_t rotated(uint32_t x, unsigned n)
{
    return x >> n | x << (32 - n);
}

/* FIPS 180-4, 6.2.2. */
static void compress(uint32_t state[8], const uint8_t *block)
{
    static const uint32_t k[64] = {
        0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
        0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
        0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
        0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
        0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
        0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
        0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
        0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
    uint32_t w[64], v[8];
    for (int i = 0; i < 16; i++)
        w[i] = (uint32_t)block[4 * i] << 24 | (uint32_t)block[4 * i + 1] << 16 | (uint32_t)block[4 * i + 2] << 8 |
               block[4 * i + 3];
    for (int i = 16; i < 64; i++)
        w[i] = w[i - 16] + (rotated(w[i - 15], 7) ^ rotated(w[i - 15], 18) ^ w[i - 15] >> 3) + w[i - 7] +
               (rotated(w[i - 2], 17) ^ rotated(w[i - 2], 19) ^ w[i - 2] >> 10);
    memcpy(v, state, sizeof v);
    for (int i = 0; i < 64; i++) {
        uint32_t t1 = v[7] + (rotated(v[4], 6) ^ rotated(v[4], 11) ^ rotated(v[4], 25)) +
                      ((v[4] & v[5]) ^ (~v[4] & v[6])) + k[i] + w[i];
        uint32_t t2 = (rotated(v[0], 2) ^ rotated(v[0], 13) ^ rotated(v[0], 22)) +
                      ((v[0] & v[1]) ^ (v[0] & v[2]) ^ (v[1] & v[2]));
        memmove(v + 1, v, 7 * sizeof v[0]);
        v[4] += t1;
        v[0] = t1 + t2;
    }
    for (int i = 0; i < 8; i++)
        state[i] += v[i];
}

static void add(struct sha256 *sha, const uint8_t *bytes, size_t size)
{
    for (size_t i = 0; i < size; i++) {
        sha->block[sha->size++ % BLOCK_BYTES] = bytes[i];
        if (sha->size % BLOCK_BYTES == 0)
            compress(sha->state, sha->block);
    }
}

static void end(struct sha256 *sha, uint8_t hash[HASH_BYTES])
{
    static const uint8_t one = 0x80, zero = 0;
    uint64_t bits = 8 * sha->size;
    add(sha, &one, 1);
    while (sha->size % BLOCK_BYTES != BLOCK_BYTES - 8)
        add(sha, &zero, 1);
    for (int i = 7; i >= 0; i--) {
        uint8_t byte = (uint8_t)(bits >> 8 * i);
        add(sha, &byte, 1);
    }
    for (int i = 0; i < HASH_BYTES; i++)
        hash[i] = (uint8_t)(sha->state[i / 4] >> (24 - 8 * (i % 4)));
}

/* One of the two hashes of HMAC (RFC 2104) begins with the key and `pad`; the key is shorter than a block. */
static struct sha256 begin(const uint8_t *key, uint8_t pad)
{
    struct sha256 sha = {{0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19},
                         {0}, 0};
    for (int i = 0; i < BLOCK_BYTES; i++) {
        uint8_t byte = (uint8_t)((i < KEY_BYTES ? key[i] : 0) ^ pad);
        add(&sha, &byte, 1);
    }
    return sha;
}

/* The signature of a packet: of its header, its message, its link and its time stamp. */
static void tag_of(const uint8_t *key, uint8_t type, uint16_t sequence, const uint8_t *message, size_t size,
                   const uint8_t *trailer, uint8_t hash[HASH_BYTES])
{
    uint8_t header[HEADER_BYTES] = {SIGNED_VERSION, type, (uint8_t)sequence, (uint8_t)(sequence >> 8)};
    struct sha256 inner = begin(key, 0x36), outer = begin(key, 0x5c);
    add(&inner, header, sizeof header);
    add(&inner, message, size);
    add(&inner, trailer, 1 + STAMP_BYTES);
    end(&inner, hash);
    add(&outer, hash, HASH_BYTES);
    end(&outer, hash);
}

static uint64_t stamp_of(const uint8_t *trailer)
{
    uint64_t stamp = 0;
    for (int i = STAMP_BYTES; i > 0; i--)
        stamp = stamp << 8 | trailer[i];
    return stamp;
}

const char *signing_refusal(const struct signing *signing, const struct packet *packet)
{
    if (signing->key == NULL)
        return packet->version == PROTOCOL_VERSION ? NULL : "this Identify is signed: this device has no key";
    if (packet->version == PROTOCOL_VERSION)
        return "this Identify is not signed";
    if (packet->version != SIGNED_VERSION || packet->size < TRAILER_BYTES)
        return "this Identify has no signature";
    uint8_t hash[HASH_BYTES], differ = 0;
    size_t size = packet->size - TRAILER_BYTES;
    const uint8_t *trailer = packet->payload + size;
    tag_of(signing->key, packet->type, packet->sequence, packet->payload, size, trailer, hash);
    for (int i = 0; i < TAG_BYTES; i++) /* all of them: how long it takes must not say which is wrong */
        differ |= hash[i] ^ trailer[1 + STAMP_BYTES + i];
    if (differ != 0)
        return "this Identify is signed with another key";
    if (trailer[0] != signing->link)
        return "this Identify is of another line";
    return stamp_of(trailer) > signing->heard ? NULL : "this Identify is sent again, or old";
}

void signing_take(struct signing *signing, struct packet *packet)
{
    packet->size -= TRAILER_BYTES;
    packet->version = PROTOCOL_VERSION;
    signing->heard = stamp_of(packet->payload + packet->size);
}

size_t signing_encode(struct signing *signing, uint8_t *wire, uint8_t type, uint16_t sequence, const uint8_t *payload,
                      size_t size)
{
    uint8_t trailer[TRAILER_BYTES], hash[HASH_BYTES];
    if (signing->key == NULL)
        return packet_encode(wire, type, sequence, payload, size);
    signing->sent = (signing->sent > signing->heard ? signing->sent : signing->heard) + 1;
    trailer[0] = signing->link ^ LINK_TO_HOST;
    for (int i = 0; i < STAMP_BYTES; i++)
        trailer[1 + i] = (uint8_t)(signing->sent >> 8 * i);
    tag_of(signing->key, type, sequence, payload, size, trailer, hash);
    memcpy(trailer + 1 + STAMP_BYTES, hash, TAG_BYTES);
    return packet_encode_version(wire, SIGNED_VERSION, type, sequence, payload, size, trailer, sizeof trailer);
}
