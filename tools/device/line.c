#include "line.h"

#include <string.h>

#include "section_vi.h"

bool line_take(struct line *line, uint8_t byte, struct packet *packet)
{
    if (!decoder_take(&line->decoder, byte, packet))
        return false;
    if (packet->version != PROTOCOL_VERSION) {
        if (packet->type == IDENTIFY)
            line_event(line, LEVEL_WARNING, 0, "this device speaks version 1 (no signed packets)");
        return false;
    }
    /* A new host counts its packets from anew: its Identify is no duplicate of the last host's. */
    if (packet->type == IDENTIFY)
        line->window.begun = false;
    line->parts.bytes = line->message;
    line->parts.room = sizeof line->message;
    return window_take(&line->window, packet->sequence) && parts_take(&line->parts, packet);
}

struct writer line_write(struct line *line)
{
    struct writer writer = {line->payload, sizeof line->payload, 0, false};
    return writer;
}

void line_send(struct line *line, enum type type, const struct writer *writer)
{
    uint16_t sequence = line->out_sequence++;
    if (writer->overflow || OUT_BYTES - line->out_size < MAX_WIRE)
        line->out_dropped++;
    else
        line->out_size +=
            packet_encode(line->out + line->out_size, (uint8_t)type, sequence, writer->bytes, writer->size);
}

void line_ack(struct line *line, const struct packet *packet, enum code code, const char *text, uint64_t step)
{
    struct writer writer = line_write(line);
    ack_encode(&writer, packet->sequence, code, text, step);
    line_send(line, ACK, &writer);
}

void line_event(struct line *line, enum level level, int64_t now_ns, const char *text)
{
    struct writer writer = line_write(line);
    event_encode(&writer, level, now_ns, text);
    line_send(line, EVENT, &writer);
}

bool line_clock_reply(struct line *line, const struct packet *packet, int64_t now_ns)
{
    struct clock_query query;
    struct writer writer = line_write(line);
    if (!clock_query_decode(&query, packet->payload, packet->size))
        return false;
    /* The answer is on its way at once unless something waits before it: a few microseconds after it came. */
    clock_reply_encode(&writer, &query, now_ns, now_ns);
    line_send(line, CLOCK_REPLY, &writer);
    return true;
}

void line_identity(struct writer *writer, uint64_t nonce, enum kind kind, const char *model,
                   uint64_t next_step, int64_t step_zero_ns)
{
    put_uint(writer, 1, nonce);
    put_uint(writer, 2, kind);
    put_text(writer, 3, model);
    put_text(writer, 4, SERIAL_NUMBER);
    put_text(writer, 5, FIRMWARE);
    put_uint(writer, 6, PROTOCOL_VERSION);
    put_bytes(writer, 7, SCHEMA_HASH, sizeof SCHEMA_HASH - 1);
    put_uint(writer, 8, FAST_STEP_NS);
    put_uint(writer, 9, next_step);
    put_uint(writer, 10, (uint64_t)step_zero_ns);
    put_text(writer, 14, RIG_DIGEST);
}

void line_clear(struct line *line)
{
    /* The driver may have half a packet already: a delimiter ends it, so that the next one is not lost with it. */
    line->out[0] = 0;
    line->out_size = 1;
    line->cleared = true;
}

bool line_not_supported(struct line *line, const struct packet *packet)
{
    if (type_is_known(packet->type))
        line_ack(line, packet, NOT_SUPPORTED, "this device does not take such a message", 0);
    return type_is_known(packet->type);
}

void line_sent(struct line *line, size_t n)
{
    memmove(line->out, line->out + n, line->out_size - n);
    line->out_size -= n;
}
