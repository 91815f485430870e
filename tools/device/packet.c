#include "packet.h"

#include <string.h>

#include "messages.h"

uint32_t crc32(uint32_t crc, const uint8_t *bytes, size_t size)
{
    /* Half a byte at a time: 64 bytes of table instead of 1024. The polynomial is 0xedb88320, as in zlib. */
    static const uint32_t table[16] = {
        0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4, 0x4db26158, 0x5005713c,
        0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c, 0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c};
    crc = ~crc;
    for (size_t i = 0; i < size; i++) {
        crc ^= bytes[i];
        crc = crc >> 4 ^ table[crc & 15];
        crc = crc >> 4 ^ table[crc & 15];
    }
    return ~crc;
}

struct cobs {
    uint8_t *wire;
    size_t code, size; /* where the run's first byte belongs; how much has been written */
};

static void cobs_put(struct cobs *cobs, const uint8_t *bytes, size_t size)
{
    for (size_t i = 0; i < size; i++) {
        /* A full run ends before the next byte, not after its own last: a packet may end with it. */
        if (cobs->size - cobs->code == 255) {
            cobs->wire[cobs->code] = 255;
            cobs->code = cobs->size++;
        }
        if (bytes[i] != 0) {
            cobs->wire[cobs->size++] = bytes[i];
        } else {
            cobs->wire[cobs->code] = (uint8_t)(cobs->size - cobs->code);
            cobs->code = cobs->size++;
        }
    }
}

size_t packet_encode(uint8_t *wire, uint8_t type, uint16_t sequence, const uint8_t *payload, size_t size)
{
    uint8_t header[HEADER_BYTES] = {PROTOCOL_VERSION, type, (uint8_t)sequence, (uint8_t)(sequence >> 8)};
    struct cobs cobs = {wire, 0, 1};
    uint32_t crc = crc32(crc32(0, header, sizeof header), payload, size);
    uint8_t tail[CRC_BYTES] = {(uint8_t)crc, (uint8_t)(crc >> 8), (uint8_t)(crc >> 16), (uint8_t)(crc >> 24)};
    cobs_put(&cobs, header, sizeof header);
    cobs_put(&cobs, payload, size);
    cobs_put(&cobs, tail, sizeof tail);
    wire[cobs.code] = (uint8_t)(cobs.size - cobs.code);
    wire[cobs.size++] = 0;
    return cobs.size;
}

static bool packet_end(struct decoder *decoder, struct packet *packet)
{
    const uint8_t *bytes = decoder->bytes;
    size_t body = decoder->size - CRC_BYTES;
    if (decoder->broken || decoder->left > 0 || decoder->size < HEADER_BYTES + CRC_BYTES) {
        decoder->bad_framing++;
        return false;
    }
    const uint8_t *tail = bytes + body;
    uint32_t crc = tail[0] | (uint32_t)tail[1] << 8 | (uint32_t)tail[2] << 16 | (uint32_t)tail[3] << 24;
    if (crc != crc32(0, bytes, body)) {
        decoder->bad_crc++;
        return false;
    }
    packet->version = bytes[0];
    packet->type = bytes[1];
    packet->sequence = (uint16_t)(bytes[2] | bytes[3] << 8);
    packet->payload = bytes + HEADER_BYTES;
    packet->size = body - HEADER_BYTES;
    return true;
}

static void keep(struct decoder *decoder, uint8_t byte)
{
    if (decoder->size < MAX_PACKET)
        decoder->bytes[decoder->size++] = byte;
    else
        decoder->broken = true;
}

bool decoder_take(struct decoder *decoder, uint8_t byte, struct packet *packet)
{
    if (byte == 0) {
        /* code is 0 only where nothing has come since the last delimiter. */
        bool whole = decoder->code != 0 && packet_end(decoder, packet);
        decoder->size = 0;
        decoder->code = decoder->left = 0;
        decoder->broken = false;
        return whole;
    }
    if (decoder->left > 0) {
        decoder->left--;
        keep(decoder, byte);
    } else {
        if (decoder->code != 0 && decoder->code != 255)
            keep(decoder, 0);
        decoder->code = byte;
        decoder->left = (uint8_t)(byte - 1);
    }
    return false;
}

bool window_take(struct window *window, uint16_t sequence)
{
    uint16_t ahead = (uint16_t)(sequence - window->newest), behind = (uint16_t)-ahead;
    if (!window->begun) {
        window->begun = true;
        window->seen = 0;
    } else if (behind <= 64) {
        if (behind == 0 || window->seen >> (behind - 1) & 1) {
            window->duplicates++;
            return false;
        }
        /* Not seen, though older: no serial line does that. It is no duplicate, so it is taken. */
        window->seen |= (uint64_t)1 << (behind - 1);
        return true;
    } else {
        window->lost += ahead - 1u;
        window->seen = ahead > 64 ? 0 : ahead == 64 ? (uint64_t)1 << 63 : (window->seen << 1 | 1) << (ahead - 1);
    }
    window->newest = sequence;
    return true;
}

bool parts_take(struct parts *parts, struct packet *packet)
{
    struct part part;
    if (packet->type != PART) {
        parts->type = 0;
        return true;
    }
    bool sense = part_decode(&part, packet->payload, packet->size) && part.size > 0 && part.size <= MAX_CHUNK &&
                 part.total <= parts->room && part.type != PART && type_is_known(part.type);
    if (sense && part.offset == 0) {
        parts->type = (uint8_t)part.type;
        parts->total = part.total;
        parts->size = 0;
    } else if (parts->type == 0 || part.type != parts->type || part.offset != parts->size ||
               part.total != parts->total || packet->sequence != (uint16_t)(parts->sequence + 1)) {
        sense = false;
    }
    if (!sense || part.size > parts->total - parts->size) {
        parts->type = 0;
        parts->refused++;
        return false;
    }
    memcpy(parts->bytes + parts->size, part.data, part.size);
    parts->size += part.size;
    parts->sequence = packet->sequence;
    if (parts->size < parts->total)
        return false;
    packet->type = parts->type;
    packet->payload = parts->bytes;
    packet->size = parts->total;
    parts->type = 0;
    return true;
}
