/* One device's end of its serial line: packets in and out, and what a camera and a mirror answer alike. */
#ifndef LINE_H
#define LINE_H

#include "messages.h"
#include "packet.h"

/* Bytes that wait to be sent. The longest burst is an answer of the mirror to AppliedQuery (two packets of MAX_WIRE) among
 * acknowledgements, or the camera's frame and its truth. What does not fit is dropped as a whole packet: the host sees
 * the gap in the sequence numbers. */
enum { OUT_BYTES = 3 * MAX_WIRE };

/* Bytes of the longest message that may come in parts. With more than 11 inputs, make it the longest block's. */
enum { MESSAGE_BYTES = MAX_PAYLOAD };

struct line {
    struct decoder decoder;
    struct window window;
    struct parts parts;
    uint8_t message[MESSAGE_BYTES];
    uint8_t out[OUT_BYTES];
    size_t out_size;
    uint16_t out_sequence;
    uint32_t out_dropped; /* packets */
    bool cleared;         /* the driver has to forget too what it has not sent; it then says false here */
    /* The payload that is being written. Identity of a mirror with hundreds of inputs would need more, and parts. */
    uint8_t payload[MAX_PAYLOAD];
};

/* True when `byte` ends a packet that is to be dealt with: whole, of this version, and no duplicate; of a message in
 * parts the last one, which is then the message. */
bool line_take(struct line *line, uint8_t byte, struct packet *packet);

/* A payload to fill, and to send. */
struct writer line_write(struct line *line);
void line_send(struct line *line, enum type type, const struct writer *writer);

void line_ack(struct line *line, const struct packet *packet, enum code code, const char *text, uint64_t step);
void line_event(struct line *line, enum level level, int64_t now_ns, const char *text);
bool line_clock_reply(struct line *line, const struct packet *packet, int64_t now_ns); /* false: no query */

/* What Identity tells of any device. */
void line_identity(struct writer *writer, uint64_t nonce, enum kind kind, const char *model,
                   uint64_t next_step, int64_t step_zero_ns);

/* Drops what waits to be sent: Identify begins a session. */
void line_clear(struct line *line);

/* The answer to a message that this kind of device does not take. False for types of no message: they get none. */
bool line_not_supported(struct line *line, const struct packet *packet);

/* The first `n` bytes of out have been sent. */
void line_sent(struct line *line, size_t n);

#endif
