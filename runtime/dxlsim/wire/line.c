/* Line of a simulated bus: instructions in, status packets out, both with their times on the wire.
 *
 * It frames instructions, decides which servos receive and answer them, answers reads from the servos' registers,
 * and passes the bytes of the line to the host as the adapter would. Python executes all other instructions, and
 * changes packets by faults: `call` runs one of its tasks. Written from the protocols alone (ROBOTIS e-Manual,
 * "Protocol 1.0", "Protocol 2.0"), without the host's packet code: a common codec would hide its own errors.
 *
 * The caller provides the time of each event, ns; the time of a line never goes back. */

#define _GNU_SOURCE
#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#ifdef __linux__
#include <poll.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#endif

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file: compiled_line.py rejects an object of another version */
#endif
#define NEVER ((int64_t)1 << 62)
#define BROADCAST 0xfe
#define STATUS 0x55
#define ALERT 0x80
#define MOST_PASSING 512  /* packets on their way to the host; bounds the memory if a host floods a line */
#define UNREAD_LIMIT 4096 /* bytes that a host may leave unread, as in the kernel's terminal buffer; then they are lost */
#define BURST 62          /* bytes that an FTDI chip delivers without its latency timer (AN232B-04): 64 - 2 for its status */
#define PIECE_PAUSE_NS 10000 /* between the pieces of a delivery: long enough for a host to distinguish them [i] */
#define STATUS_BYTES 11   /* status packet of Protocol 2.0 without data: the slot of an absent servo has this length [i] */
#define PING_REPLY 14     /* bytes of a reply to a ping, Protocol 2.0 */
#define SLOT_NS 1000000   /* time by which a servo's slot after a broadcast ping exceeds its reply [i] */
#define LATENESSES 1000
#define NOTE_ROOM 16

enum { PING = 0x01, READ = 0x02, SYNC_READ = 0x82, SYNC_WRITE = 0x83, FAST_SYNC_READ = 0x8a, BULK_READ = 0x92,
       FAST_BULK_READ = 0x9a };
enum { INTO, OUT }; /* directions in the ledger, as seen from the servos */
/* Tasks of Python, in the order of compiled_line.py */
enum { STEP, RECEIVES, PRESENT, EXECUTE, EXECUTE_ALL, REFUSED, STAYS_OUT, CHAIN, OVERHEAR, NOTE, ACT, ACT_AFTER,
       DISTURB, ALTER, PIECE, LEDGER, RATE, WRITTEN };

typedef struct { /* bytes that grow */
    uint8_t *data;
    int64_t size, room;
} Bytes;

typedef struct { /* one instruction packet */
    const uint8_t *raw;
    const uint8_t *parameters;
    int32_t id, instruction, size, raw_size;
    int32_t intact, end; /* `end`: index after its last byte, in the bytes that completed it */
} Packet;

typedef struct { /* finds instruction packets among the bytes that a host sends, despite noise; holds at most one */
    int32_t protocol, unused;
    Bytes held, packet, body;
} Receiver;

typedef struct { /* address range that a group read asks of one servo */
    int32_t id, address, length;
} Entry;

typedef struct { /* part of a node's registers that is about to be read */
    int32_t node, address, length;
} Asked;

typedef struct { /* goal of a servo, and the values that it accepts now */
    int64_t lowest, highest;
    int32_t address, size, is_signed, unused;
} Goal;

typedef struct { /* one servo or device, as the line sees it */
    uint8_t *memory;
    const uint8_t *owned;  /* for each byte: 1: it belongs to an item; 2: reads of it are refused */
    const int32_t *alias;  /* for a byte of Indirect Data the address of its Indirect Address; -1 for other bytes */
    int64_t now_ns, received_ns, deaf_until_ns, delay_ns, later_ns;
    int64_t received, replied, last_error;
    int32_t size, has_gaps, id, secondary_id, baud_rate, silent, speaks;
    int32_t asks;          /* 1: Python decides whether it receives an instruction */
    int32_t answers_damaged, level_at, error_at, error_size, error_bits;
    int32_t group_reads;   /* bits: sync, bulk, fast sync, fast bulk read */
    int32_t least_entries; /* shortest list of a group read that it answers */
    int32_t goal_count;
    const Goal *goals;
    /* Writes the motion into `memory`: motion_show of mechanics.c; NULL: Python sets registers before they are read */
    void (*show)(void *shaft, int64_t now_ns, int32_t address, int32_t length);
    /* Follows goals that only change a trajectory: motion_take_goal of mechanics.c; returns 0: Python follows them */
    int32_t (*take_goal)(void *shaft, int64_t now_ns);
    int64_t aims;          /* bits of these goals; 0: Python follows all goals */
    void *shaft;
} Node;

typedef struct { /* entries of simulated buses, which Python takes in batches */
    Bytes entries;
    int64_t most; /* bytes from which Python is asked to take them; 0: no file is written */
    int32_t on, unused;
} Ledger;

typedef struct { /* reply that Python may disturb */
    int64_t first_ns, due_ns;
    const uint8_t *data;
    int32_t size, unused;
} Reply;

typedef struct Transmission { /* contiguous bytes on their way to the host: a reply, noise, or an echo */
    int64_t first_ns, due_ns; /* begin of the first byte on the wire, end of the last one */
    int64_t group;            /* group read that continues after it; 0: none */
    int64_t turn_end_ns;
    int32_t turn, size, given, broken, uses;
    char note[NOTE_ROOM];
    uint8_t data[];
} Transmission;

typedef struct { /* pointers that grow */
    Transmission **at;
    int32_t count, room;
} Queue;

typedef struct { /* one delivery to the host */
    int64_t planned_ns;
    uint8_t *data;
    int32_t size;
    Queue ended; /* transmissions that are complete with it */
} Delivery;

typedef struct { /* one servo's reply in a group read; two servos with one ID send at once */
    int64_t delay_ns, at; /* `at`: index of its bytes */
    int32_t size, error;
} GroupReply;

typedef struct { /* turn of one ID in a group read */
    int64_t slot_bytes;
    int32_t id, first, count;
} Turn;

typedef struct {
    int64_t (*call)(int32_t task, int64_t first, int64_t second);
    Node **nodes;
    Ledger *ledger;
    int64_t now_ns, host_free_ns, end_ns, packets;
    int64_t planned_ns;   /* time of the next planned action; NEVER: none */
    int64_t planned_after; /* number of packets after which the next one runs; NEVER: none */
    int32_t (*step)(void *mechanics, int64_t now_ns); /* motion_step_to of mechanics.c; not 0: Python continues */
    void *mechanics;
    int64_t timer_ns, delivered, baud_rate;
    int32_t node_count, protocol, bus, done; /* `done`: set by Python at the end of a task */
    int32_t plugged, unplugged; /* `unplugged`: number of times */
    int32_t wedged, echo, slots, recorded, altered, waits;
    int32_t split; /* adapter: 0: whole replies, 1: single bytes, 2: random pieces */
    uint8_t disturbed[256];
    uint8_t answer[16]; /* data of a reply of Python */
    int32_t answer_size, entry_count;
    int32_t raised; /* 1: a task raised an exception, which Python raises when the line has returned */
    Entry *entries;     /* of the group read that is being executed */
    Asked *asked;
    Packet packet;
    Reply reply;
    int64_t lateness_ns[1000]; /* of the recent deliveries, compared with their planned times; in real time only */
} Line;

typedef struct { /* a line with what only this file uses */
    Line line;
    Receiver receiver;
    Queue passing, arrived;
    Delivery *burst;
    int32_t burst_count, burst_room, burst_at;
    int32_t piece, entry_room, asked_room, turn_room, reply_room;
    int64_t timed_ns, group, groups;
    int32_t turn_count, sent, reply_count, has_slots;
    Turn *turns;
    GroupReply *replies;
    Bytes group_data, out, text, sending;
    const Transmission *disturbed;
    int32_t *heard;
    int32_t heard_room;
} Bus;

/* Memory */

static void *grown(void *old, int64_t bytes)
{
    void *new = realloc(old, (size_t)(bytes ? bytes : 1));
    if (!new)
        abort();
    return new;
}

static uint8_t *room_for(Bytes *b, int64_t size)
{
    if (b->size + size > b->room) {
        b->room = (b->size + size) * 2;
        b->data = grown(b->data, b->room);
    }
    return b->data + b->size;
}

static void append(Bytes *b, const void *data, int64_t size)
{
    if (size) {
        memcpy(room_for(b, size), data, (size_t)size);
        b->size += size;
    }
}

static void append_byte(Bytes *b, int32_t byte)
{
    *room_for(b, 1) = (uint8_t)byte;
    b->size++;
}

static void drop(Transmission *t)
{
    if (!--t->uses)
        free(t);
}

static void insert(Queue *q, int32_t index, Transmission *t)
{
    if (q->count == q->room) {
        q->room = q->room ? q->room * 2 : 16;
        q->at = grown(q->at, q->room * (int64_t)sizeof *q->at);
    }
    memmove(q->at + index + 1, q->at + index, (size_t)(q->count - index) * sizeof *q->at);
    q->at[index] = t;
    q->count++;
}

static Transmission *removed(Queue *q, int32_t index)
{
    Transmission *t = q->at[index];
    q->count--;
    memmove(q->at + index, q->at + index + 1, (size_t)(q->count - index) * sizeof *q->at);
    return t;
}

static void clear(Queue *q)
{
    while (q->count)
        drop(q->at[--q->count]);
}

/* Checksums */

static uint16_t crc_of_byte[256];

__attribute__((constructor)) static void fill_crc(void)
{
    for (int32_t byte = 0; byte < 256; byte++) {
        int32_t crc = byte << 8;
        for (int32_t bit = 0; bit < 8; bit++)
            crc = crc << 1 ^ (crc & 0x8000 ? 0x18005 : 0);
        crc_of_byte[byte] = (uint16_t)crc;
    }
}

/* Return the CRC-16 of bytes: polynomial 8005 (hex), not reflected; `crc` is that of the bytes before. */
uint16_t line_crc(const uint8_t *data, int64_t size, uint16_t crc)
{
    while (size--)
        crc = (uint16_t)(crc << 8 ^ crc_of_byte[crc >> 8 ^ *data++]);
    return crc;
}

/* Return the checksum of Protocol 1.0, given the bytes between header and checksum. */
static uint8_t checksum(const uint8_t *body, int64_t size)
{
    uint8_t sum = 0;
    while (size--)
        sum = (uint8_t)(sum + *body++);
    return (uint8_t)~sum;
}

/* Byte stuffing, so that instruction and parameters contain no header: FF FF FD is followed by another FD */

static void append_stuffed(Bytes *to, const uint8_t *data, int64_t size)
{
    int64_t start = to->size;
    for (int64_t i = 0; i < size; i++) {
        append_byte(to, data[i]);
        const uint8_t *last = to->data + to->size - 3;
        if (data[i] == 0xfd && to->size - start >= 3 && last[0] == 0xff && last[1] == 0xff)
            append_byte(to, 0xfd);
    }
}

static void append_unstuffed(Bytes *to, const uint8_t *data, int64_t size)
{
    for (int64_t i = 0; i < size; i++) {
        append_byte(to, data[i]);
        if (i >= 2 && i + 1 < size && data[i] == 0xfd && data[i + 1] == 0xfd && data[i - 1] == 0xff &&
            data[i - 2] == 0xff)
            i++;
    }
}

/* Append a status packet, the reply of a servo. */
static void append_status(Bytes *to, int32_t protocol, int32_t id, int32_t error, const uint8_t *data, int64_t size)
{
    int64_t start = to->size;
    if (protocol == 1) {
        const uint8_t head[5] = {0xff, 0xff, (uint8_t)id, (uint8_t)(size + 2), (uint8_t)error};
        append(to, head, 5);
        append(to, data, size);
        append_byte(to, checksum(to->data + start + 2, to->size - start - 2));
        return;
    }
    const uint8_t head[9] = {0xff, 0xff, 0xfd, 0, (uint8_t)id, 0, 0, STATUS, (uint8_t)error};
    append(to, head, 9);
    append_stuffed(to, data, size);
    int64_t length = to->size - start - 7 + 2;
    to->data[start + 5] = (uint8_t)length;
    to->data[start + 6] = (uint8_t)(length >> 8);
    uint16_t crc = line_crc(to->data + start, to->size - start, 0);
    append_byte(to, crc & 0xff);
    append_byte(to, crc >> 8);
}

/* Instructions */

static const uint8_t HEADER[4] = {0xff, 0xff, 0xfd, 0};

static int32_t header_size(int32_t protocol) { return protocol == 1 ? 2 : 4; }

/* Return the size of a packet that begins so, -1 if the beginning is too short, -2 if it begins no packet. */
static int64_t packet_size(int32_t protocol, const uint8_t *head, int64_t count)
{
    int32_t header = header_size(protocol), fixed = header + (protocol == 1 ? 2 : 3);
    if (memcmp(head, HEADER, (size_t)(count < header ? count : header)))
        return -2;
    if (count > header && (head[header] == 0xff || (protocol == 2 && head[header] == 0xfd)))
        return -2; /* no ID */
    if (count < fixed)
        return -1;
    int32_t length = protocol == 1 ? head[3] : head[5] | head[6] << 8;
    return length < (protocol == 1 ? 2 : 3) ? -2 : fixed + length;
}

static Packet packet_of(Receiver *r, int64_t end)
{
    const uint8_t *raw = r->packet.data;
    int64_t size = r->packet.size;
    Packet p = {.raw = raw, .raw_size = (int32_t)size, .end = (int32_t)end};
    if (r->protocol == 1) {
        p.id = raw[2];
        p.instruction = raw[4];
        p.parameters = raw + 5;
        p.size = size > 6 ? (int32_t)size - 6 : 0;
        p.intact = raw[size - 1] == checksum(raw + 2, size - 3);
        return p;
    }
    r->body.size = 0;
    append_unstuffed(&r->body, raw + 7, size - 9);
    p.id = raw[4];
    p.instruction = r->body.data[0];
    p.parameters = r->body.data + 1;
    p.size = (int32_t)r->body.size - 1;
    p.intact = line_crc(raw, size - 2, 0) == (raw[size - 2] | raw[size - 1] << 8);
    return p;
}

/* Process bytes until a packet is complete, also one with a wrong checksum. Return 0 if none is; otherwise continue
 * at `end`, the index after its last byte. */
int32_t line_feed(Receiver *r, const uint8_t *data, int64_t size, int64_t start, Packet *found)
{
    Bytes *held = &r->held;
    int64_t before = held->size, at = 0, whole;
    append(held, data + start, size - start);
    while ((whole = packet_size(r->protocol, held->data + at, held->size - at)) == -2)
        at++;
    if (whole < 0 || at + whole > held->size) {
        if (at)
            memmove(held->data, held->data + at, (size_t)(held->size - at));
        held->size -= at;
        return 0;
    }
    r->packet.size = 0;
    append(&r->packet, held->data + at, whole);
    held->size = 0;
    *found = packet_of(r, start + at + whole - before);
    return 1;
}

Receiver *line_receiver(int32_t protocol)
{
    Receiver *r = calloc(1, sizeof *r);
    if (!r)
        abort();
    r->protocol = protocol;
    room_for(&r->held, 64);
    return r;
}

void line_free_receiver(Receiver *r)
{
    free(r->held.data);
    free(r->packet.data);
    free(r->body.data);
    free(r);
}

static int32_t word(const uint8_t *data) { return data[0] | data[1] << 8; }

static int is_fast(int32_t instruction) { return instruction == FAST_SYNC_READ || instruction == FAST_BULK_READ; }

/* Parse a sync, bulk or fast read into `entries`, which has room for one entry per parameter. Return their number; 0
 * for another or a malformed instruction. */
int32_t line_group_read(int32_t protocol, const Packet *p, Entry *entries)
{
    const uint8_t *d = p->parameters;
    int32_t count = 0, instruction = p->instruction;
    int64_t length = 1;
    if (!p->intact || p->id != BROADCAST)
        return 0;
    if (protocol == 1) {
        if (instruction != BULK_READ || p->size < 4 || d[0] || (p->size - 1) % 3)
            return 0;
        for (int32_t at = 1; at < p->size; at += 3) {
            int32_t known = 0; /* for an ID that is listed twice the first entry counts */
            while (known < count && entries[known].id != d[at + 1])
                known++;
            if (known == count)
                entries[count++] = (Entry){d[at + 1], d[at + 2], d[at]};
        }
        return count;
    }
    if (instruction == SYNC_READ || instruction == FAST_SYNC_READ)
        for (int32_t at = 4; at < p->size; at++)
            entries[count++] = (Entry){d[at], word(d), word(d + 2)};
    else if (instruction == BULK_READ || instruction == FAST_BULK_READ)
        for (int32_t at = 0; p->size % 5 == 0 && at < p->size; at += 5)
            entries[count++] = (Entry){d[at], word(d + at + 1), word(d + at + 3)};
    for (int32_t i = 0; i < count; i++)
        length += entries[i].length + 4;
    return is_fast(instruction) && length > 0xffff ? 0 : count;
}

/* Parameters of a read: address and length. Return 0 if they are malformed. */
int32_t line_read(int32_t protocol, const uint8_t *d, int32_t size, Entry *entry)
{
    if (size != (protocol == 1 ? 2 : 4))
        return 0;
    entry->address = protocol == 1 ? d[0] : word(d);
    entry->length = protocol == 1 ? d[1] : word(d + 2);
    return 1;
}

/* Run a task of Python. A signal may raise an exception before Python's function has begun, which could not store it. */
static int64_t run_task(Bus *b, int32_t task, int64_t first, int64_t second)
{
    b->line.done = 0;
    int64_t result = b->line.call(task, first, second);
    b->line.raised |= !b->line.done;
    return result;
}

/* Notes and ledger */

static void note(Bus *b, const char *format, ...)
{
    char text[128];
    va_list values;
    va_start(values, format);
    int size = vsnprintf(text, sizeof text, format, values);
    va_end(values);
    append(&b->text, text, size);
    run_task(b, NOTE, (int64_t)(intptr_t)b->text.data, b->text.size);
    b->text.size = 0;
}

static void put_text(Bus *b, const char *text) { append(&b->text, text, (int64_t)strlen(text)); }

static void put_hex(Bus *b, const uint8_t *data, int64_t size)
{
    for (int64_t i = 0; i < size; i++) {
        char byte[4];
        append(&b->text, byte, snprintf(byte, sizeof byte, i ? " %02x" : "%02x", data[i]));
    }
}

static void record(Bus *b, int64_t t_ns, int32_t direction, const char *text, const uint8_t *data, int64_t size,
                   int64_t late_ns)
{
    Ledger *ledger = b->line.ledger;
    if (!ledger->on)
        return;
    const int64_t times[3] = {t_ns, late_ns, size};
    const int32_t kind[4] = {b->line.bus, direction, (int32_t)strlen(text), 0};
    append(&ledger->entries, times, sizeof times);
    append(&ledger->entries, kind, sizeof kind);
    append(&ledger->entries, text, kind[2]);
    append(&ledger->entries, data, size);
    if (ledger->most && ledger->entries.size > ledger->most)
        run_task(b, LEDGER, 0, 0);
}

/* Bytes on the line, ordered by their end */

static int64_t duration_ns(const Bus *b, int64_t size) { return size * 10000000000 / b->line.baud_rate; }

static int64_t passed_ns(const Transmission *t, int64_t index)
{
    return t->size ? t->first_ns + (t->due_ns - t->first_ns) * (index + 1) / t->size : t->due_ns;
}

static Transmission *transmission(const uint8_t *data, int64_t size, int64_t first_ns, int64_t due_ns, const char *text)
{
    Transmission *t = grown(NULL, (int64_t)sizeof *t + size);
    *t = (Transmission){.first_ns = first_ns, .due_ns = due_ns, .size = (int32_t)size, .uses = 1};
    for (int32_t i = 0; i < NOTE_ROOM - 1 && text[i]; i++)
        t->note[i] = text[i];
    if (size)
        memcpy(t->data, data, (size_t)size);
    return t;
}

static int is_echo(const Transmission *t) { return !strcmp(t->note, "echo"); }

static int overlaps(const Transmission *t, int64_t begin_ns, int64_t end_ns)
{
    return !is_echo(t) && t->first_ns < end_ns && begin_ns < t->due_ns;
}

static void insert_by_end(Queue *q, Transmission *t)
{
    int32_t index = q->count;
    while (index && q->at[index - 1]->due_ns > t->due_ns)
        index--;
    insert(q, index, t);
}

/* Return what two simultaneous senders cause: the AND of their bytes, as two drivers pulling low [i]. */
static Transmission *mixed(Bus *b, Transmission *one, Transmission *other)
{
    const Transmission *early = other->first_ns < one->first_ns ? other : one, *late = early == one ? other : one;
    const Transmission *awaited = one->group ? one : other;
    int64_t offset = (int64_t)rint((double)(late->first_ns - early->first_ns) / (double)duration_ns(b, 1));
    int64_t size = offset + late->size > early->size ? offset + late->size : early->size;
    Transmission *t = grown(NULL, (int64_t)sizeof *t + size);
    *t = *awaited;
    t->uses = 1;
    t->first_ns = early->first_ns;
    t->due_ns = early->first_ns + duration_ns(b, size);
    t->size = (int32_t)size;
    t->given = early->given;
    strcpy(t->note, "collision");
    memset(t->data, 0xff, (size_t)size); /* an idle line reads as FF, the neutral element of AND */
    memcpy(t->data, early->data, (size_t)early->size);
    for (int32_t i = 0; i < late->size; i++)
        t->data[offset + i] &= late->data[i];
    t->broken = size != awaited->size || memcmp(t->data, awaited->data, (size_t)size);
    return t;
}

/* Send a transmission to the host, mixed with those that are on the wire at the same time: a collision. */
static void transmit(Bus *b, Transmission *new)
{
    Queue *q = &b->passing;
    if (q->count >= MOST_PASSING) {
        note(b, "%d bytes to the host are lost: too many transmissions overlap", new->size);
        drop(new);
        return;
    }
    int64_t begin_ns = new->first_ns, end_ns = new->due_ns;
    for (int32_t i = 0; q->count && q->at[q->count - 1]->due_ns > begin_ns && i < q->count;) {
        if (!overlaps(q->at[i], begin_ns, end_ns)) {
            i++;
            continue;
        }
        Transmission *other = removed(q, i), *both;
        put_text(b, "collision: ");
        put_hex(b, other->data, other->size);
        put_text(b, " overlaps ");
        put_hex(b, new->data, new->size);
        note(b, "");
        both = mixed(b, other, new);
        drop(other);
        drop(new);
        new = both;
    }
    insert_by_end(q, new);
}

/* Remove those replies of the current group read that have not begun because they wait for the end of another one:
 * an event may come before them. */
void line_withdraw(Bus *b)
{
    Queue *q = &b->passing;
    int32_t first = 0;
    while (first < q->count && (!b->group || q->at[first]->group != b->group))
        first++;
    if (first == q->count)
        return;
    b->sent = q->at[first]->turn + 1;
    for (int32_t i = first; i < q->count;)
        if (q->at[i]->group == b->group && q->at[i]->turn >= b->sent)
            drop(removed(q, i));
        else
            i++;
}

/* Apply a collision of the host's bytes from `position` with replies. A servo does not receive while it sends: it
 * sees the host's bytes as 0 [i], and the rest of its reply is lost. */
static void talk_over(Bus *b, uint8_t *sent, int64_t size, int64_t position, int64_t start_ns)
{
    Queue *q = &b->passing;
    int64_t byte_ns = duration_ns(b, 1);
    int64_t begin_ns = start_ns + duration_ns(b, position), end_ns = start_ns + duration_ns(b, size);
    int32_t met = 0;
    Transmission *cut[MOST_PASSING + 1];
    for (int32_t i = 0; i < q->count;)
        if (overlaps(q->at[i], begin_ns, end_ns) && met <= MOST_PASSING)
            cut[met++] = removed(q, i);
        else
            i++;
    for (int32_t i = 0; i < met; i++) {
        Transmission *t = cut[i];
        int64_t first = (t->first_ns - start_ns) / byte_ns, last = (t->due_ns - start_ns + byte_ns - 1) / byte_ns;
        int64_t kept = t->first_ns < begin_ns ? (begin_ns - t->first_ns) / byte_ns : 0;
        first = first > position ? first : position;
        last = last < size ? last : size;
        if (last > first)
            memset(sent + first, 0, (size_t)(last - first));
        put_text(b, "collision: the host sends during ");
        put_hex(b, t->data, t->size);
        note(b, "; reply cut to %lld bytes", (long long)kept);
        if (kept < t->size)
            t->size = (int32_t)kept;
        t->due_ns = t->first_ns + duration_ns(b, kept);
        t->broken = 1;
        strcpy(t->note, "collision");
        if (kept)
            insert_by_end(q, t);
        else
            drop(t);
    }
}

/* Adapter: when the host receives bytes, and in which pieces */

static int32_t next_piece(Bus *b)
{
    if (b->line.split != 2)
        return b->line.split ? 1 : UNREAD_LIMIT;
    int64_t drawn = run_task(b, PIECE, 0, 0);
    return drawn > 0 ? (int32_t)drawn : 1;
}

static int is_immediate(const Bus *b) { return !b->line.timer_ns && !b->line.split; }

static Transmission *in_adapter(const Bus *b, int32_t index)
{
    return index < b->arrived.count ? b->arrived.at[index] : b->passing.at[index - b->arrived.count];
}

/* Return the time at which the latency timer expires with a byte waiting, or a full burst is complete. The timer
 * restarts with each delivery. It also expires with an empty buffer (AN232B-04). */
static int64_t timer_end_ns(const Bus *b)
{
    const Transmission *t = in_adapter(b, 0);
    int64_t timer_ns = b->line.timer_ns, oldest_ns = passed_ns(t, t->given), missing = BURST;
    if (oldest_ns <= b->timed_ns)
        oldest_ns = b->timed_ns + 1;
    int64_t runs_out_ns = b->timed_ns + (oldest_ns - b->timed_ns + timer_ns - 1) / timer_ns * timer_ns;
    for (int32_t i = 0; i < b->arrived.count + b->passing.count; i++) {
        t = in_adapter(b, i);
        if (t->size - t->given >= missing) {
            int64_t full_ns = passed_ns(t, t->given + missing - 1);
            full_ns = full_ns > b->timed_ns ? full_ns : b->timed_ns;
            return full_ns < runs_out_ns ? full_ns : runs_out_ns;
        }
        missing -= t->size - t->given;
    }
    return runs_out_ns;
}

/* Return the time of the next delivery to the host if nothing else happens; NEVER without bytes. */
static int64_t next_delivery_ns(const Bus *b)
{
    if (b->burst_at < b->burst_count)
        return b->burst[b->burst_at].planned_ns;
    if (!b->arrived.count && !b->passing.count)
        return NEVER;
    if (b->line.timer_ns)
        return timer_end_ns(b);
    const Transmission *t = in_adapter(b, 0);
    int32_t end = t->given + b->piece < t->size ? t->given + b->piece : t->size;
    return passed_ns(t, end - 1);
}

/* Take up to a burst of bytes that have passed the wire as one delivery. */
static Delivery gathered(Bus *b, int64_t now_ns)
{
    Delivery d = {.planned_ns = now_ns};
    Bytes data = {0};
    for (int32_t i = 0; i < b->arrived.count + b->passing.count; i++) {
        Transmission *t = in_adapter(b, i);
        if (t->first_ns >= now_ns)
            continue;
        int64_t first = t->given, end = first + BURST - data.size;
        end = end < t->size ? end : t->size;
        if (t->due_ns > now_ns)
            while (end > first && passed_ns(t, end - 1) > now_ns)
                end--;
        t->given = (int32_t)end;
        append(&data, t->data + first, end - first);
        if (end == t->size && t->size) {
            t->uses++;
            insert(&d.ended, d.ended.count, t);
        }
    }
    while (b->arrived.count && b->arrived.at[0]->given == b->arrived.at[0]->size)
        drop(removed(&b->arrived, 0));
    d.data = data.data;
    d.size = (int32_t)data.size;
    return d;
}

static void queue_delivery(Bus *b, Delivery d)
{
    if (b->burst_at == b->burst_count)
        b->burst_at = b->burst_count = 0;
    if (b->burst_count == b->burst_room) {
        b->burst_room = b->burst_room ? b->burst_room * 2 : 16;
        b->burst = grown(b->burst, b->burst_room * (int64_t)sizeof *b->burst);
    }
    b->burst[b->burst_count++] = d;
}

/* Queue a delivery in its pieces. */
static void split(Bus *b, Delivery whole)
{
    if (!b->line.split) {
        queue_delivery(b, whole);
        return;
    }
    int64_t planned_ns = whole.planned_ns;
    for (int32_t start = 0, end; start < whole.size; start = end, planned_ns += PIECE_PAUSE_NS) {
        end = start + b->piece < whole.size ? start + b->piece : whole.size;
        b->piece = next_piece(b);
        Delivery d = {.planned_ns = planned_ns, .size = end - start};
        d.data = grown(NULL, d.size);
        memcpy(d.data, whole.data + start, (size_t)d.size);
        if (end == whole.size) {
            d.ended = whole.ended;
            whole.ended = (Queue){0};
        }
        queue_delivery(b, d);
    }
    clear(&whole.ended);
    free(whole.ended.at);
    free(whole.data);
}

/* Hand bytes over to the host. Return how late. `handed_ns` < 0: not in real time. */
static int64_t hand_over(Bus *b, const uint8_t *data, int64_t size, int64_t planned_ns, int64_t handed_ns)
{
    int64_t late_ns = handed_ns < 0 ? 0 : handed_ns - planned_ns;
    append(&b->out, data, size);
    if (handed_ns >= 0)
        b->line.lateness_ns[b->line.delivered % LATENESSES] = late_ns;
    return late_ns;
}

static void record_sent(Bus *b, const Transmission *t, int64_t late_ns)
{
    record(b, t->due_ns, OUT, t->note, t->data, t->size, late_ns);
}

/* Hand over the next delivery that has been gathered, and enter what is complete with it. */
static void hand_over_burst(Bus *b, int64_t handed_ns)
{
    Delivery d = b->burst[b->burst_at++];
    int64_t late_ns = hand_over(b, d.data, d.size, d.planned_ns, handed_ns);
    for (int32_t i = 0; i < d.ended.count; i++)
        record_sent(b, d.ended.at[i], late_ns);
    clear(&d.ended);
    free(d.ended.at);
    free(d.data);
}

/* Hand over the next piece of the oldest transmission, by an adapter without a timer. */
static void hand_over_piece(Bus *b, int64_t due_ns, int64_t handed_ns)
{
    Transmission *t = in_adapter(b, 0);
    int32_t left = t->size - t->given, size = b->piece < left ? b->piece : left;
    int64_t late_ns = hand_over(b, t->data + t->given, size, due_ns, handed_ns);
    t->given += size;
    if (t->given == t->size) {
        record_sent(b, t, late_ns);
        drop(removed(&b->arrived, 0)); /* its last byte has passed the wire */
    }
    b->piece = next_piece(b);
}

/* Replies */

static void send_reply(Bus *b, int32_t id, Transmission *t, int32_t *sent)
{
    if (!b->line.disturbed[id]) {
        transmit(b, t);
        *sent = 1;
        return;
    }
    const Transmission *outer = b->disturbed;
    b->disturbed = t;
    b->line.reply = (Reply){t->first_ns, t->due_ns, t->data, t->size, 0};
    if (run_task(b, DISTURB, id, 0))
        *sent = 1;
    b->disturbed = outer;
    drop(t);
}

/* Send one copy of the reply that is being disturbed. After the last copy its group read continues. `unnoticed`: it is
 * changed, or lost, after the servos have received it. */
void line_send_copy(Bus *b, const uint8_t *data, int64_t size, int64_t first_ns, int32_t last, int32_t unnoticed)
{
    const Transmission *t = b->disturbed;
    int64_t due_ns = unnoticed ? t->due_ns : first_ns + duration_ns(b, size);
    Transmission *copy = transmission(data, size, first_ns, due_ns, t->note);
    copy->group = last ? t->group : 0;
    copy->turn = t->turn;
    copy->turn_end_ns = t->turn_end_ns;
    copy->broken = !unnoticed && (size != t->size || memcmp(data, t->data, (size_t)size));
    transmit(b, copy);
}

/* Send the reply of one node by itself. */
void line_send_reply(Bus *b, int32_t id, const uint8_t *data, int64_t size, int64_t first_ns, int64_t due_ns)
{
    int32_t sent;
    send_reply(b, id, transmission(data, size, first_ns, due_ns, ""), &sent);
}

/* Send other bytes to the host, such as noise. */
void line_send(Bus *b, const uint8_t *data, int64_t size, int64_t first_ns, const char *text)
{
    transmit(b, transmission(data, size, first_ns, first_ns + duration_ns(b, size), text));
}

/* Send the next replies of the group read, starting when the line is free at `free_ns`. If nothing else is on the
 * line, a reply is sent before the previous one has ended. Any event between them removes it again. */
static void send_turns(Bus *b, int64_t free_ns)
{
    int32_t alone = !b->passing.count, sent_any = 0;
    int64_t group = b->group;
    while (b->sent < b->turn_count) {
        const Turn turn = b->turns[b->sent];
        int32_t plain = alone && turn.count == 1 && !b->line.disturbed[turn.id], sent = 0;
        if (sent_any && !plain)
            return; /* decided when the previous reply has passed */
        int64_t slot_ns = b->has_slots ? duration_ns(b, turn.slot_bytes) : 0;
        int64_t end_ns = free_ns + slot_ns, due_ns = end_ns;
        for (int32_t i = 0; i < turn.count; i++) { /* two servos with one ID send at once */
            const GroupReply *r = &b->replies[turn.first + i];
            int64_t first_ns = free_ns + r->delay_ns;
            end_ns = first_ns + slot_ns;
            due_ns = first_ns + duration_ns(b, r->size);
            Transmission *t = transmission(b->group_data.data + r->at, r->size, first_ns, due_ns, "");
            t->group = group;
            t->turn = b->sent;
            t->turn_end_ns = end_ns;
            send_reply(b, turn.id, t, &sent);
        }
        b->sent++;
        if (sent && !plain)
            return;
        if (!sent && !b->has_slots) {
            note(b, "servo %d does not reply, nor do those after it in the chain", turn.id);
            break;
        }
        sent_any |= sent;
        free_ns = sent ? due_ns : end_ns;
    }
    if (!sent_any)
        b->group = 0;
}

/* Time */

/* Pass a transmission that has ended on the wire to the adapter, and send the next reply of a group read that waited
 * for its end. */
static void arrive(Bus *b, Transmission *t)
{
    Line *l = &b->line;
    int32_t header = header_size(l->protocol);
    l->now_ns = t->due_ns > l->now_ns ? t->due_ns : l->now_ns;
    if (!l->plugged || l->wedged) {
        char count[64];
        snprintf(count, sizeof count, "%d bytes to the host are lost: ", t->size);
        put_text(b, count);
        put_hex(b, t->data, t->size);
        note(b, "");
    } else if (t->size) {
        int64_t waiting = t->size;
        for (int32_t i = 0; i < b->arrived.count; i++)
            waiting += b->arrived.at[i]->size;
        if (b->arrived.count && waiting > UNREAD_LIMIT)
            note(b, "%d bytes to the host are lost: the host does not read", t->size);
        else {
            t->uses++;
            insert(&b->arrived, b->arrived.count, t);
        }
    }
    if (l->waits && !t->note[0] && !t->broken && t->size > header && !memcmp(t->data, HEADER, (size_t)header))
        run_task(b, OVERHEAR, t->data[header], t->due_ns);
    if (t->group && t->group == b->group && b->sent <= t->turn + 1) {
        if (!t->broken)
            send_turns(b, t->due_ns);
        else if (b->has_slots)
            send_turns(b, t->due_ns > t->turn_end_ns ? t->due_ns : t->turn_end_ns);
        else {
            note(b, "broken reply: the servos after it in the chain do not reply");
            b->group = 0;
        }
    }
    drop(t);
}

/* Process all events up to `now_ns`: ends of transmissions and planned actions, in the order of their times. */
void line_pass_time(Bus *b, int64_t now_ns)
{
    Line *l = &b->line;
    while (!l->raised) {
        int64_t due_ns = b->passing.count ? b->passing.at[0]->due_ns : now_ns + 1;
        if (l->planned_ns < due_ns && l->planned_ns <= now_ns) {
            l->now_ns = l->planned_ns > l->now_ns ? l->planned_ns : l->now_ns;
            run_task(b, ACT, 0, 0);
        } else if (due_ns <= now_ns)
            arrive(b, removed(&b->passing, 0));
        else
            break;
    }
    l->now_ns = now_ns > l->now_ns ? now_ns : l->now_ns;
}

/* Return the time of the next event without input: bytes to deliver to the host, or a fault; NEVER without any. */
int64_t line_next_due(const Bus *b)
{
    int64_t due_ns = b->line.wedged ? NEVER : next_delivery_ns(b);
    if (b->passing.count && b->passing.at[0]->due_ns < due_ns)
        due_ns = b->passing.at[0]->due_ns; /* a group read may continue after its end */
    return b->line.planned_ns < due_ns ? b->line.planned_ns : due_ns;
}

/* Return `line_next_due`, or the end of the last reply that ends at most `gather_ns` later. */
int64_t line_next_delivery(const Bus *b, int64_t gather_ns)
{
    int64_t due_ns = line_next_due(b), last_ns = due_ns + gather_ns;
    int32_t index = 0;
    if (!b->passing.count || due_ns != b->passing.at[0]->due_ns || !is_immediate(b))
        return due_ns;
    if (b->line.planned_ns - 1 < last_ns)
        last_ns = b->line.planned_ns - 1 > due_ns ? b->line.planned_ns - 1 : due_ns;
    while (index + 1 < b->passing.count && b->passing.at[index + 1]->due_ns <= last_ns)
        index++;
    return b->passing.at[index]->due_ns;
}

/* Append the bytes that the host receives by `now_ns` to `out`, each once, and write them to the ledger. Return the
 * number of bytes there, which `line_take` removes. */
int64_t line_drain(Bus *b, int64_t now_ns, int64_t handed_ns)
{
    int32_t handed = 0;
    line_pass_time(b, now_ns);
    /* After an exception, replies that are due have not arrived. */
    if (b->line.wedged || b->line.raised)
        return b->out.size;
    for (;;) {
        int64_t due_ns;
        /* Without a timer a transmission is delivered in the moment in which it leaves the wire. */
        if (is_immediate(b) && !b->arrived.count && b->burst_at == b->burst_count)
            break;
        if ((due_ns = next_delivery_ns(b)) > now_ns)
            break;
        if (b->burst_at < b->burst_count)
            hand_over_burst(b, handed_ns);
        else if (b->line.timer_ns) {
            b->timed_ns = due_ns;
            split(b, gathered(b, due_ns));
            continue;
        } else
            hand_over_piece(b, due_ns, handed_ns);
        handed = 1;
    }
    if (handed && handed_ns >= 0)
        b->line.delivered++;
    return b->out.size;
}

/* Move up to `room` delivered bytes to `data`. Return their number. */
int64_t line_take(Bus *b, uint8_t *data, int64_t room)
{
    int64_t size = b->out.size < room ? b->out.size : room;
    if (!size)
        return 0;
    memcpy(data, b->out.data, (size_t)size);
    b->out.size -= size;
    memmove(b->out.data, b->out.data + size, (size_t)b->out.size);
    return size;
}

/* Discard all bytes that the adapter has not delivered. */
void line_discard(Bus *b)
{
    clear(&b->arrived);
    for (; b->burst_at < b->burst_count; b->burst_at++) {
        Delivery *d = &b->burst[b->burst_at];
        clear(&d->ended);
        free(d->ended.at);
        free(d->data);
    }
}

/* Set the latency timer and restart it. */
void line_set_timer(Bus *b, int64_t timer_ns)
{
    b->line.timer_ns = timer_ns;
    b->timed_ns = b->line.now_ns;
}

/* Registers */

static int32_t value_at(const Node *n, int32_t at, int32_t size)
{
    int32_t value = 0;
    for (int32_t i = 0; i < size; i++)
        value |= n->memory[at + i] << 8 * i;
    return value;
}

static int32_t level(const Node *n) { return n->level_at < 0 ? 2 : n->memory[n->level_at]; }

/* Return the error bits of every reply. */
static int32_t error_state(const Node *n)
{
    return n->error_bits | (n->error_at >= 0 && value_at(n, n->error_at, n->error_size) ? ALERT : 0);
}

/* Return true if a host can read a range. */
static int is_readable(const Node *n, int32_t address, int32_t length)
{
    int32_t readable = n->has_gaps;
    if (length < 1 || address + length > n->size)
        return 0;
    for (int32_t at = address; at < address + length; at++) {
        if (n->owned[at] == 2)
            return 0;
        readable |= n->owned[at];
    }
    return readable;
}

/* Append the bytes of a range as a host reads them. Cells between items are 0, and so are targets of Indirect
 * Addresses beyond the table [i]. */
static void append_registers(Bytes *to, const Node *n, int32_t address, int32_t length)
{
    uint8_t *data = room_for(to, length);
    for (int32_t at = address; at < address + length; at++) {
        int32_t target = n->alias[at] < 0 ? at : value_at(n, n->alias[at], 2);
        *data++ = target < n->size ? n->memory[target] : 0;
    }
    to->size += length;
}

/* Instructions */

/* 1: a unit receives what the host sends: their rates differ by less than 3 % (e-Manual, Baud Rate (4)) */
int32_t line_rates_match(int64_t unit, int64_t host)
{
    return fabs((double)unit - (double)host) < 0.03 * (double)host;
}

static int listens_to(const Bus *b, const Node *n, int32_t id)
{
    if (id != BROADCAST && id != n->id && id != n->secondary_id)
        return 0;
    return line_rates_match(n->baud_rate, b->line.baud_rate);
}

/* Advance the mechanics to `now_ns`, if a step is due. */
static void step_to(Bus *b, int64_t now_ns)
{
    if (b->line.step(b->line.mechanics, now_ns))
        run_task(b, STEP, now_ns, 0);
}

/* Return true if a node receives an instruction that ends at `now_ns`: it is connected, has booted, and is not
 * silenced. */
static int receives(Bus *b, int32_t index, int64_t now_ns)
{
    Node *n = b->line.nodes[index];
    if (n->silent || now_ns < n->deaf_until_ns || !n->speaks)
        return 0;
    if (n->asks) {
        if (!run_task(b, RECEIVES, index, now_ns))
            return 0;
    } else
        step_to(b, now_ns);
    n->now_ns = now_ns > n->now_ns ? now_ns : n->now_ns;
    n->received_ns = n->now_ns;
    return 1;
}

static void count_reply(Node *n, int32_t error)
{
    n->replied++;
    n->last_error = error;
}

/* Let Python set registers that show present values, before they are read. */
static void ask(Bus *b, int32_t *count, int32_t node, int32_t address, int32_t length)
{
    if (*count == b->asked_room) {
        b->asked_room = b->asked_room ? b->asked_room * 2 : 16;
        b->line.asked = grown(b->line.asked, b->asked_room * (int64_t)sizeof(Asked));
    }
    b->line.asked[(*count)++] = (Asked){node, address, length};
}

static void show(const Node *n, const Asked *range, int64_t now_ns)
{
    int32_t end = range->address + range->length, aliased = 0;
    for (int32_t at = range->address; at < end; at++)
        aliased |= n->alias[at] >= 0;
    if (!aliased)
        n->show(n->shaft, now_ns, range->address, range->length);
    else
        for (int32_t at = range->address; at < end; at++)
            n->show(n->shaft, now_ns, n->alias[at] < 0 ? at : value_at(n, n->alias[at], 2), 1);
}

/* Set the registers in the ranges that are about to be read to their present values. */
static void present(Bus *b, int32_t count, int64_t now_ns)
{
    int32_t left = 0;
    for (int32_t i = 0; i < count; i++) {
        const Node *n = b->line.nodes[b->line.asked[i].node];
        if (n->show)
            show(n, &b->line.asked[i], now_ns);
        else
            left = 1;
    }
    if (left)
        run_task(b, PRESENT, count, now_ns);
}

static int32_t group_read_bit(int32_t instruction)
{
    return instruction == SYNC_READ ? 1 : instruction == BULK_READ ? 2 : instruction == FAST_SYNC_READ ? 4 : 8;
}

/* Return true if a node replies to its entry of a group read. */
static int answers_entry(Bus *b, int32_t index, const Packet *p, const Entry *e, int64_t now_ns, int32_t *error)
{
    const Node *n = b->line.nodes[index];
    if (!receives(b, index, now_ns))
        return 0;
    if (!(n->group_reads & group_read_bit(p->instruction)) || b->line.entry_count < n->least_entries) {
        run_task(b, STAYS_OUT, index, 0);
        return 0;
    }
    if (level(n) < 1)
        return 0;
    *error = is_readable(n, e->address, e->length) ? 0 : b->line.protocol == 1 ? 0x08 : 7; /* range, access error */
    if (*error && is_fast(p->instruction)) { /* its format has no room for an error without data [i] */
        run_task(b, STAYS_OUT, index, 1);
        return 0;
    }
    return 1;
}

static Turn *new_turn(Bus *b, int32_t id, int64_t slot_bytes)
{
    if (b->turn_count == b->turn_room) {
        b->turn_room = b->turn_room ? b->turn_room * 2 : 32;
        b->turns = grown(b->turns, b->turn_room * (int64_t)sizeof(Turn));
    }
    b->turns[b->turn_count] = (Turn){slot_bytes, id, b->reply_count, 0};
    return &b->turns[b->turn_count++];
}

static void new_reply(Bus *b, const GroupReply *reply)
{
    if (b->reply_count == b->reply_room) {
        b->reply_room = b->reply_room ? b->reply_room * 2 : 32;
        b->replies = grown(b->replies, b->reply_room * (int64_t)sizeof(GroupReply));
    }
    b->replies[b->reply_count++] = *reply;
}

/* Decide who replies to a group read, in which order. Return the number of ranges to read. */
static int32_t decide_turns(Bus *b, const Packet *p, int64_t now_ns)
{
    int32_t fast = is_fast(p->instruction), count = 0;
    for (int32_t i = 0; i < b->line.entry_count; i++) {
        const Entry e = b->line.entries[i];
        Turn *turn = new_turn(b, e.id, STATUS_BYTES + e.length);
        for (int32_t index = 0; index < b->line.node_count; index++) {
            Node *n = b->line.nodes[index];
            int32_t error;
            if (n->id != e.id || !listens_to(b, n, e.id))
                continue; /* a servo never replies to its secondary ID */
            n->received++;
            if (!answers_entry(b, index, p, &e, now_ns, &error))
                continue;
            /* In a shared status packet only the first servo waits its Return Delay Time. */
            GroupReply r = {.delay_ns = fast && i ? n->later_ns : n->delay_ns, .error = error};
            new_reply(b, &r);
            turn->count++;
            ask(b, &count, index, e.address, error ? 0 : e.length);
        }
        if (!turn->count && !b->has_slots)
            break; /* the servos after it wait in vain */
    }
    return count;
}

/* Append the bytes that a servo adds to the shared status packet of a fast read. Each CRC covers everything before
 * it, including earlier CRCs. The packet has no byte stuffing. */
static void append_part(Bus *b, const Node *n, int32_t error, int64_t data_at, uint16_t *crc, int32_t first)
{
    Bytes *to = &b->group_data;
    int64_t start = to->size, size = b->sending.size - data_at, length = 1;
    if (first) {
        for (int32_t i = 0; i < b->line.entry_count; i++)
            length += b->line.entries[i].length + 4;
        const uint8_t head[8] = {0xff, 0xff, 0xfd, 0, BROADCAST, (uint8_t)length, (uint8_t)(length >> 8), STATUS};
        append(to, head, 8);
    }
    append_byte(to, error);
    append_byte(to, n->id);
    append(to, b->sending.data + data_at, size);
    if (!first) {
        const uint8_t sent[2] = {(uint8_t)*crc, (uint8_t)(*crc >> 8)};
        *crc = line_crc(sent, 2, *crc);
    }
    *crc = line_crc(to->data + start, to->size - start, *crc);
    append_byte(to, *crc & 0xff);
    append_byte(to, *crc >> 8);
}

/* Compose the replies to a group read, which show the states at the end of the instruction. */
static void compose_replies(Bus *b, int32_t fast)
{
    uint16_t crc = 0;
    b->group_data.size = 0;
    for (int32_t i = 0; i < b->reply_count; i++) {
        GroupReply *r = &b->replies[i];
        Node *n = b->line.nodes[b->line.asked[i].node];
        int32_t error = r->error | error_state(n);
        b->sending.size = 0;
        append_registers(&b->sending, n, b->line.asked[i].address, b->line.asked[i].length);
        r->at = b->group_data.size;
        if (fast)
            append_part(b, n, error, 0, &crc, !i);
        else
            append_status(&b->group_data, b->line.protocol, n->id, error, b->sending.data, b->sending.size);
        r->size = (int32_t)(b->group_data.size - r->at);
        count_reply(n, error);
    }
}

static void execute_group_read(Bus *b, const Packet *p, int64_t end_ns)
{
    step_to(b, end_ns);
    b->turn_count = b->reply_count = b->sent = 0;
    b->group = ++b->groups;
    b->has_slots = b->line.slots && b->line.protocol == 2 && !is_fast(p->instruction);
    int32_t count = decide_turns(b, p, end_ns);
    present(b, count, end_ns);
    compose_replies(b, is_fast(p->instruction));
    if (b->line.waits)
        run_task(b, CHAIN, end_ns, 0);
    send_turns(b, end_ns);
}

/* Return true if a status packet follows an instruction (Status Return Level). Of the broadcasts only a ping is
 * answered; instructions to the Secondary ID are not. */
static int replies_to(const Node *n, const Packet *p)
{
    int own = p->id == n->id;
    if (!p->intact)
        return own && n->answers_damaged && level(n) >= 2;
    if (p->instruction == PING)
        return own || p->id == BROADCAST;
    return own && level(n) >= (p->instruction == READ ? 1 : 2);
}

/* Find the data of a node in a sync write. Return NULL if they are not there exactly once, with its own ID; `listed` is
 * 0 if the list is right and has nothing for the node. */
static const uint8_t *listed_data(int32_t protocol, const Packet *p, const Node *n, Entry *place, int32_t *listed)
{
    const uint8_t *d = p->parameters, *found = NULL;
    int32_t start = protocol == 1 ? 2 : 4, size = p->size - start;
    *listed = 1;
    if (size <= 0)
        return NULL;
    *place = (Entry){n->id, protocol == 1 ? d[0] : word(d), protocol == 1 ? d[1] : word(d + 2)};
    if (!place->length || size % (place->length + 1))
        return NULL;
    *listed = 0;
    for (int32_t at = start; at < p->size; at += place->length + 1)
        if (d[at] == n->id || d[at] == n->secondary_id) {
            found = d[at] == n->id && !*listed ? d + at + 1 : NULL;
            *listed += 1;
        }
    return found;
}

/* Write whole goals, all with values that the servo accepts. Return the bits of these goals; 0: nothing is written. */
static int64_t write_goals(const Node *n, const Entry *place, const uint8_t *data)
{
    int64_t written = 0;
    for (int32_t at = 0; at < place->length;) {
        int32_t i = 0;
        while (i < n->goal_count && n->goals[i].address != place->address + at)
            i++;
        if (i == n->goal_count || at + n->goals[i].size > place->length)
            return 0;
        const Goal *g = &n->goals[i];
        int64_t value = 0;
        for (int32_t byte = 0; byte < g->size; byte++)
            value |= (int64_t)data[at + byte] << 8 * byte;
        if (g->is_signed && value >> (8 * g->size - 1))
            value -= (int64_t)1 << 8 * g->size;
        if (value < g->lowest || value > g->highest)
            return 0;
        written |= (int64_t)1 << i;
        at += g->size;
    }
    memcpy(n->memory + place->address, data, (size_t)place->length);
    return written;
}

static void execute_for(Bus *b, int32_t index, const Packet *p, int64_t end_ns)
{
    Node *n = b->line.nodes[index];
    Entry place;
    n->received += p->intact;
    if (!receives(b, index, end_ns))
        return;
    if (p->intact && p->instruction == SYNC_WRITE && p->id == BROADCAST) {
        int32_t listed;
        const uint8_t *data = listed_data(b->line.protocol, p, n, &place, &listed);
        int64_t written = data ? write_goals(n, &place, data) : 0;
        if (written && ((written & ~n->aims) || !n->take_goal(n->shaft, end_ns)))
            run_task(b, WRITTEN, index, written);
        if (written || !listed)
            return;
    }
    int32_t id = n->id; /* a write of ID is still answered with the old ID [i] */
    int64_t error, delay_ns = n->delay_ns, replies = replies_to(n, p);
    if (p->instruction == PING && p->id == BROADCAST && b->line.protocol == 2)
        delay_ns += id * (PING_REPLY * (10000000000 / n->baud_rate) + SLOT_NS);
    b->line.answer_size = 0;
    b->sending.size = 0;
    if (p->intact && p->instruction == READ && line_read(b->line.protocol, p->parameters, p->size, &place)) {
        int32_t count = 0, readable = is_readable(n, place.address, place.length);
        error = readable ? 0 : b->line.protocol == 1 ? 0x08 : 7; /* range, access error */
        ask(b, &count, index, place.address, readable ? place.length : 0);
        present(b, 1, end_ns);
        if (error)
            run_task(b, REFUSED, index, error);
        else
            append_registers(&b->sending, n, place.address, place.length);
    } else {
        error = run_task(b, EXECUTE, index, end_ns);
        append(&b->sending, b->line.answer, b->line.answer_size);
    }
    if (!replies || error < 0)
        return;
    error |= error_state(n);
    count_reply(n, (int32_t)error);
    b->group_data.size = 0;
    append_status(&b->group_data, b->line.protocol, id, (int32_t)error, b->sending.data, b->sending.size);
    int64_t first_ns = end_ns + delay_ns;
    line_send_reply(b, id, b->group_data.data, b->group_data.size, first_ns,
                    first_ns + duration_ns(b, b->group_data.size));
}

static void count_packet(Bus *b)
{
    b->line.packets++;
    if (b->line.planned_after <= b->line.packets)
        run_task(b, ACT_AFTER, 0, 0);
}

static void execute(Bus *b, const Packet *p, int64_t end_ns)
{
    Line *l = &b->line;
    int32_t count = 0;
    b->group = 0; /* servos that wait for their turn stop at another instruction */
    l->packet = *p;
    l->end_ns = end_ns;
    if (l->recorded)
        run_task(b, EXECUTE_ALL, end_ns, 0);
    else {
        if (p->size > b->entry_room) {
            b->entry_room = p->size * 2;
            l->entries = grown(l->entries, b->entry_room * (int64_t)sizeof(Entry));
        }
        l->entry_count = line_group_read(l->protocol, p, l->entries);
        if (l->entry_count)
            execute_group_read(b, p, end_ns);
        else {
            if (l->node_count > b->heard_room) {
                b->heard_room = l->node_count * 2;
                b->heard = grown(b->heard, b->heard_room * (int64_t)sizeof(int32_t));
            }
            for (int32_t i = 0; i < l->node_count; i++) /* first: an instruction may change the IDs */
                if (listens_to(b, l->nodes[i], p->id))
                    b->heard[count++] = i;
            for (int32_t i = 0; i < count; i++)
                execute_for(b, b->heard[i], p, end_ns);
        }
    }
    count_packet(b);
}

/* Execute the packets in bytes that servos receive instead of an instruction, because of a fault. */
void line_execute_altered(Bus *b, const uint8_t *data, int64_t size)
{
    Packet p;
    int64_t end_ns = b->line.end_ns, position = 0;
    while (line_feed(&b->receiver, data, size, position, &p)) {
        position = p.end;
        execute(b, &p, end_ns);
    }
    if (!position) /* even an unparsable instruction counts as a packet */
        count_packet(b);
}

/* Execute the instruction of another host, whose last byte passes the line at `end_ns`. */
void line_execute(Bus *b, const uint8_t *data, int64_t size, int64_t end_ns)
{
    Receiver *other = line_receiver(b->line.protocol);
    Packet p;
    if (line_feed(other, data, size, 0, &p))
        execute(b, &p, end_ns);
    line_free_receiver(other);
}

/* Send the host's bytes, from `start_ns`, to the servos, which execute each complete instruction. */
static void send_to_servos(Bus *b, const uint8_t *data, int64_t size, int64_t start_ns)
{
    uint8_t *mutable = NULL;
    int64_t position = 0;
    Packet p;
    while (position < size && !b->line.raised) {
        line_withdraw(b);
        if (b->passing.count) {
            if (!mutable) {
                mutable = grown(NULL, size);
                memcpy(mutable, data, (size_t)size);
                data = mutable;
            }
            talk_over(b, mutable, size, position, start_ns);
        }
        if (!line_feed(&b->receiver, data, size, position, &p))
            break;
        position = p.end;
        int64_t end_ns = start_ns + duration_ns(b, position);
        if (b->line.altered) {
            b->line.packet = p;
            b->line.end_ns = end_ns;
            run_task(b, ALTER, 0, 0);
        } else
            execute(b, &p, end_ns);
    }
    free(mutable);
}

/* Receive bytes that the host writes to its adapter at `at_ns`. They are sent after bytes written earlier. */
void line_receive(Bus *b, const uint8_t *data, int64_t size, int64_t at_ns)
{
    Line *l = &b->line;
    line_pass_time(b, at_ns);
    record(b, at_ns, INTO, "", data, size, 0);
    if (l->wedged || !l->plugged) {
        note(b, "%lld bytes from the host are lost", (long long)size);
        return;
    }
    int64_t start_ns = at_ns > l->host_free_ns ? at_ns : l->host_free_ns;
    int64_t longest_pause_ns = l->protocol == 1 ? 100000000 : 1500000; /* e-Manual; the gap inside an instruction */
    if (b->receiver.held.size && start_ns - l->host_free_ns > longest_pause_ns) {
        note(b, "incomplete instruction of %lld bytes discarded", (long long)b->receiver.held.size);
        b->receiver.held.size = 0;
    }
    l->host_free_ns = start_ns + duration_ns(b, size);
    send_to_servos(b, data, size, start_ns);
    if (l->echo && size)
        insert_by_end(&b->passing, transmission(data, size, start_ns, l->host_free_ns, "echo"));
}

/* Discard the bytes of an incomplete instruction. */
void line_discard_packet(Bus *b) { b->receiver.held.size = 0; }

/* A line, at the time `start_ns`, whose adapter has a latency timer and splits what it delivers. */
Bus *line_new(int32_t protocol, int64_t start_ns)
{
    Bus *b = calloc(1, sizeof *b);
    if (!b)
        abort();
    b->line.protocol = b->receiver.protocol = protocol;
    b->line.now_ns = b->line.host_free_ns = b->timed_ns = start_ns;
    b->line.planned_ns = b->line.planned_after = NEVER;
    b->line.plugged = 1;
    room_for(&b->receiver.held, 64);
    return b;
}

/* Begin to use the adapter, after its properties were set. */
void line_start(Bus *b) { b->piece = next_piece(b); }

void line_free(Bus *b)
{
    line_discard(b);
    clear(&b->passing);
    free(b->passing.at);
    free(b->arrived.at);
    free(b->burst);
    free(b->turns);
    free(b->replies);
    free(b->heard);
    free(b->line.entries);
    free(b->line.asked);
    free(b->receiver.held.data);
    free(b->receiver.packet.data);
    free(b->receiver.body.data);
    free(b->group_data.data);
    free(b->out.data);
    free(b->text.data);
    free(b->sending.data);
    free(b);
}

/* Virtual time: ports of lines that a host in this process opens. `functions` has the layout that dxlwire documents in
 * ports.py; each of them gets the ports as its context. */

typedef struct { /* host's end of one line */
    Bus *bus;
    int32_t opened; /* how often the adapter had been unplugged when the port was opened */
    int32_t lost;   /* 1: the host has requested the line again */
} Port;

typedef struct {
    void *context;
    int64_t (*now)(void *context);
    int32_t (*send)(void *context, int32_t line, const uint8_t *data, int32_t size);
    int32_t (*receive)(void *context, int32_t line, uint8_t *data, int32_t room);
    int32_t (*wait)(void *context, int64_t deadline_ns, uint8_t *ready);
    void (*sleep)(void *context, int64_t until_ns);
    Port *ports;
    int64_t *clock;                      /* dxlwire's VirtualClock: the time, and the time of the next scheduled call */
    int64_t (*advance)(int64_t until_ns); /* lets the clock make the calls that are due */
    int32_t count, raised;               /* `raised`: `advance` raised an exception */
    int32_t done, unused;                /* as in Line */
} Ports;

static int32_t is_gone(const Port *p) { return p->bus->line.unplugged != p->opened; }

static int64_t ports_now(void *context) { return ((Ports *)context)->clock[0]; }

static void ports_sleep(void *context, int64_t until_ns)
{
    Ports *p = context;
    if (p->clock[1] <= until_ns) {
        p->done = 0;
        p->advance(until_ns);
        p->raised |= !p->done;
    } else if (until_ns > p->clock[0])
        p->clock[0] = until_ns;
}

static int32_t ports_send(void *context, int32_t line, const uint8_t *data, int32_t size)
{
    Ports *p = context;
    Bus *b = p->ports[line].bus;
    if (p->raised || b->line.raised || is_gone(&p->ports[line]))
        return -1;
    line_receive(b, data, size, p->clock[0]);
    return b->line.raised ? -1 : size;
}

static int32_t ports_receive(void *context, int32_t line, uint8_t *data, int32_t room)
{
    Ports *p = context;
    Bus *b = p->ports[line].bus;
    if (p->raised || b->line.raised || is_gone(&p->ports[line]))
        return -1;
    line_drain(b, p->clock[0], -1);
    return b->line.raised ? -1 : (int32_t)line_take(b, data, room);
}

/* Advance the time until bytes arrive or `deadline_ns`. `ready` has one flag per line. Return the number of readable
 * lines; a line that has failed is readable. */
static int32_t ports_wait(void *context, int64_t deadline_ns, uint8_t *ready)
{
    Ports *p = context;
    memset(ready, 0, (size_t)p->count);
    for (;;) {
        int64_t now_ns = p->clock[0], until_ns = deadline_ns;
        int32_t found = 0;
        for (int32_t i = 0; i < p->count; i++) { /* time passes for the servos of a lost line, too */
            const Port *port = &p->ports[i];
            int64_t waiting = line_drain(port->bus, now_ns, -1);
            int32_t failed = p->raised || port->bus->line.raised;
            ready[i] = failed || (!port->lost && (waiting || is_gone(port)));
            found += ready[i];
        }
        if (found || now_ns >= deadline_ns)
            return found;
        for (int32_t i = 0; i < p->count; i++) {
            int64_t due_ns = line_next_due(p->ports[i].bus);
            until_ns = due_ns < until_ns ? due_ns : until_ns;
        }
        ports_sleep(p, until_ns);
    }
}

/* Set the functions of ports; the caller owns their memory. */
void line_open_ports(Ports *p)
{
    p->context = p;
    p->now = ports_now;
    p->send = ports_send;
    p->receive = ports_receive;
    p->wait = ports_wait;
    p->sleep = ports_sleep;
}

/* Open the port of a line: bytes that were delivered to another one are lost. */
void line_open_port(Ports *p, int32_t line)
{
    Port *port = &p->ports[line];
    port->opened = port->bus->line.unplugged;
    port->lost = 0;
    port->bus->out.size = 0;
}

/* The functions for hosts in Python */

int32_t line_port_send(Ports *p, int32_t line, const uint8_t *data, int32_t size) { return ports_send(p, line, data, size); }

int32_t line_port_receive(Ports *p, int32_t line, uint8_t *data, int32_t room) { return ports_receive(p, line, data, room); }

int32_t line_port_wait(Ports *p, int64_t deadline_ns, uint8_t *ready) { return ports_wait(p, deadline_ns, ready); }

/* Real time: pseudo-terminals of lines that hosts open, or sockets in their place, served together */

#ifdef __linux__

#define CHUNK 4096                   /* bytes of one read; a shorter result means that no more bytes are waiting */
#define MOST_BACKLOG_NS 20000000     /* host's bytes that wait for the wire, as wire time; then the host is not read */
#define TOGETHER_NS 50000            /* replies of several lines that end within this time are delivered together */
#define GATHER_NS 250000             /* replies that end within this time are delivered together, as by USB */
#define LONGEST_SLEEP_NS 10000000    /* while a host watches the progress, so that a longer pause shows as a stall */
#define STALL_NS 20000000            /* pause between two readings of the clock from which it counts as a stall */
#define MOST_EARLY_NS 50000          /* a sleep ends some 30 us late on a stock kernel */
#define SLOWLY 64                    /* sleeps in which the estimate of this time follows a longer one */
#define IDLE_NS 300000               /* time before a delivery in which a few steps of the mechanics have room */
#define EVENTS_A_LOOK 64             /* the others wait for the next look */
#define OF_PYTHON UINT64_MAX         /* number of each descriptor of Python, which wakes the server as well */

enum { TAKEN, SERVED, GIVEN, DUE }; /* words of a line's progress, for the host: heartbeat.py */
enum { ADAPTER = 1, ASKED_FOR = 2, RAISED = 4 }; /* what Python has to do */

/* TCGETS2 of Linux, and where its struct termios2 has the output rate; the header that says so is not among those
   with which wheels are built. */
#define GET_SETTINGS 0x802C542AUL
#define OUTPUT_RATE 40

typedef struct { /* simulation's end of a terminal, whose other end hosts open like the port of an adapter */
    Bus *bus;
    int64_t *progress; /* words of the line's progress; NULL: nobody watches */
    int64_t taken_ns, served_ns;
    int64_t due_ns;    /* of the next delivery */
    int64_t held_ns;   /* time until which the terminal is not read because its host is too fast; 0: it is read */
    int32_t descriptor, opened; /* `opened`: how often the adapter had been unplugged */
    int32_t plugged, ready, size, known;
    int32_t has_settings, unused; /* 0: a socket carries the bytes, at the rate of the line */
    uint8_t settings[44]; /* struct termios2 at the host's last write; valid if `known` */
    uint8_t chunk[4096];
} Terminal;

typedef struct {
    Terminal **terminals;
    void (*stalled)(int64_t begin_ns, int64_t end_ns);
    void *(*release)(void);        /* Python's lock: PyEval_SaveThread and PyEval_RestoreThread */
    void (*acquire)(void *thread);
    int64_t (*next_step)(const void *mechanics); /* motion_next_step of mechanics.c */
    int64_t python_ns;             /* time of Python's next work, which need not be punctual; NEVER: none */
    Ledger *ledger;
    int64_t flush_ns;              /* delay of this work after the first entry of a ledger that is written to a file */
    int64_t looked_ns;
    int64_t early_ns;              /* time by which a sleep ends later than requested, at least */
    int32_t count, waiting;        /* `waiting`: descriptor of epoll */
    int32_t watched, news;
    int32_t single;                /* 1: Python looks at the shafts after each event */
    int32_t alone;                 /* 1: no other thread needs Python's lock */
} Server;

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void publish(Terminal *t, int32_t word, int64_t value)
{
    atomic_store_explicit((_Atomic int64_t *)&t->progress[word], value, memory_order_release);
}

/* Publish that a line is served up to its next delivery to the host. */
static int64_t publish_served(Terminal *t)
{
    int64_t due_ns = line_next_delivery(t->bus, GATHER_NS);
    if (t->progress && due_ns != t->served_ns) {
        publish(t, SERVED, due_ns);
        t->served_ns = due_ns;
    }
    return due_ns;
}

/* Return the time. If the process was stalled before, let Python publish the stall. */
static int64_t look_at_clock(Server *s)
{
    int64_t now_ns = clock_ns(), since_ns = s->looked_ns;
    s->looked_ns = now_ns;
    if (s->watched && now_ns - since_ns > STALL_NS)
        s->stalled(since_ns, now_ns);
    return now_ns;
}

static int has_run_task(const Server *s)
{
    int any = 0;
    for (int32_t i = 0; i < s->count; i++)
        any |= s->terminals[i]->bus->line.done || s->terminals[i]->bus->line.raised;
    return any;
}

/* Return the time of the next delivery to any host, NEVER without one, or of the last one that is due shortly after it.
 * Publish the time of each line. */
int64_t line_find_delivery(const Server *s)
{
    int64_t soonest_ns = NEVER, last_ns;
    for (int32_t i = 0; i < s->count; i++) {
        int64_t due_ns = s->terminals[i]->due_ns = publish_served(s->terminals[i]);
        soonest_ns = due_ns < soonest_ns ? due_ns : soonest_ns;
    }
    last_ns = soonest_ns;
    for (int32_t i = 0; i < s->count; i++) {
        int64_t due_ns = s->terminals[i]->due_ns;
        last_ns = due_ns > last_ns && due_ns - soonest_ns < TOGETHER_NS ? due_ns : last_ns;
    }
    return last_ns;
}

static int32_t changed(const Terminal *t)
{
    return t->opened != t->bus->line.unplugged || t->plugged != t->bus->line.plugged;
}

/* Read one chunk of bytes that the host has written, and keep it. */
int32_t line_read_chunk(Terminal *t)
{
    ssize_t count = t->size < CHUNK ? read(t->descriptor, t->chunk + t->size, (size_t)(CHUNK - t->size)) : 0;
    t->size += count > 0 ? (int32_t)count : 0; /* no data, or no host */
    return t->size == CHUNK;
}

/* Pass the bytes that were read to the line, as written at `now_ns`, with the host's baud rate. Return their number. */
int32_t line_accept(Terminal *t, int64_t now_ns)
{
    uint8_t settings[sizeof t->settings] = {0};
    int32_t size = t->size;
    t->size = 0;
    if (!size)
        return 0;
    if (t->has_settings)
        ioctl(t->descriptor, GET_SETTINGS, settings);
    if (!t->known || memcmp(settings, t->settings, sizeof settings)) { /* the rate changes only with the settings */
        uint32_t rate;
        memcpy(t->settings, settings, sizeof settings);
        memcpy(&rate, settings + OUTPUT_RATE, sizeof rate);
        t->known = 1;
        if (rate && (int64_t)rate != t->bus->line.baud_rate)
            run_task(t->bus, RATE, rate, 0);
    }
    line_receive(t->bus, t->chunk, size, now_ns);
    return size;
}

/* Write the bytes of the line that are due to the host; bytes that do not fit into the terminal are lost. */
void line_deliver(Terminal *t, int64_t now_ns)
{
    Bus *b = t->bus;
    int64_t handed_ns = clock_ns();
    if (!line_drain(b, now_ns, handed_ns))
        return;
    if (t->progress) {
        t->progress[DUE] = handed_ns - b->line.lateness_ns[(b->line.delivered + LATENESSES - 1) % LATENESSES];
        publish(t, GIVEN, handed_ns);
    }
    ssize_t written = write(t->descriptor, b->out.data, (size_t)b->out.size);
    int64_t lost = b->out.size - (written > 0 ? written : 0);
    b->out.size = 0;
    if (lost)
        note(b, "%lld bytes to the host are lost: the host does not read", (long long)lost);
}

static void watch(const Server *s, int32_t index, int operation)
{
    /* Edge-triggered, to report each write of a host once: a terminal without a host is at end of file all the time */
    struct epoll_event event = {.events = EPOLLIN | EPOLLET, .data.u64 = (uint64_t)index};
    epoll_ctl(s->waiting, operation, s->terminals[index]->descriptor, &event);
}

static void receive_from(Server *s, int32_t index, int64_t now_ns)
{
    Terminal *t = s->terminals[index];
    if (line_next_due(t->bus) <= now_ns)
        line_deliver(t, now_ns);
    if (!t->plugged || changed(t))
        return;
    int32_t more = t->size == CHUNK, count = line_accept(t, now_ns);
    if (count && t->progress) {
        int64_t start_ns = t->taken_ns > now_ns ? t->taken_ns : now_ns;
        t->taken_ns = start_ns + duration_ns(t->bus, count);
        publish_served(t); /* first: a host that sees the bytes as received relies on the due time of the reply */
        publish(t, TAKEN, t->taken_ns);
    }
    if (t->bus->line.host_free_ns - MOST_BACKLOG_NS > now_ns) {
        t->held_ns = t->bus->line.host_free_ns - MOST_BACKLOG_NS;
        watch(s, index, EPOLL_CTL_DEL);
    } else if (more)
        watch(s, index, EPOLL_CTL_MOD); /* reports the waiting bytes once more */
}

/* Look which descriptors are ready. */
static int32_t look(Server *s)
{
    struct epoll_event events[EVENTS_A_LOOK];
    int32_t count = epoll_wait(s->waiting, events, EVENTS_A_LOOK, 0), found = 0;
    for (int32_t i = 0; i < count; i++, found++)
        if (events[i].data.u64 != OF_PYTHON)
            s->terminals[events[i].data.u64]->ready = 1;
        else
            s->news |= ASKED_FOR;
    return found;
}

/* Return the estimate of the time by which a sleep ends too late, at least, after one that ended `late_ns` too late. */
int64_t line_early(int64_t early_ns, int64_t late_ns)
{
    early_ns = late_ns < early_ns ? late_ns : early_ns + (late_ns - early_ns) / SLOWLY;
    return early_ns < MOST_EARLY_NS ? early_ns : MOST_EARLY_NS;
}

/* Wait until a host writes, a delivery is due, or other work, which need not be punctual. Other threads get Python's
 * lock. */
static void wait_for_event(Server *s, int64_t due_ns, int64_t easy_ns)
{
    void *thread = s->alone ? NULL : s->release();
    int64_t wake_ns = due_ns == NEVER ? NEVER : due_ns - s->early_ns;
    int64_t until_ns = easy_ns < wake_ns ? easy_ns : wake_ns, left_ns = until_ns - clock_ns();
    struct pollfd one = {s->waiting, POLLIN, 0};
    struct timespec timeout = {left_ns / 1000000000, left_ns % 1000000000};
    /* ppoll, because epoll alone has only milliseconds */
    if (left_ns > 0 && !ppoll(&one, 1, until_ns == NEVER ? NULL : &timeout, NULL)) {
        if (until_ns == wake_ns)
            s->early_ns = line_early(s->early_ns, clock_ns() - wake_ns);
        left_ns = 0;
    } else if (look(s))
        left_ns = 1;
    while (left_ns <= 0 && until_ns == wake_ns && clock_ns() < due_ns) /* rarely: most sleeps end later */
        ;
    if (thread)
        s->acquire(thread);
}

/* Deliver what is due, and receive what hosts have written. */
static void serve_event(Server *s)
{
    int64_t now_ns = look_at_clock(s);
    /* Replies that were due before the host wrote go out first, because the host could have read them. */
    for (int32_t i = 0; i < s->count; i++)
        if (s->terminals[i]->due_ns <= now_ns)
            line_deliver(s->terminals[i], now_ns);
    for (int32_t rounds = s->count, any = 1; any;) { /* a host that drives all buses writes to them in one go */
        any = 0;
        for (int32_t i = 0; i < s->count; i++)
            if (s->terminals[i]->ready) {
                line_read_chunk(s->terminals[i]);
                any++;
            }
        /* Read after the bytes, so that no host gets a reply before it wrote, even if other lines take long */
        now_ns = look_at_clock(s);
        for (int32_t i = 0; i < s->count; i++)
            if (s->terminals[i]->ready) {
                s->terminals[i]->ready = 0;
                receive_from(s, i, now_ns);
            }
        any = any && any < s->count && --rounds > 0 && look(s);
    }
}

/* Resume reading slowed hosts. Return the time at which the next one is read; NEVER without one. */
static int64_t resume(Server *s, int64_t now_ns)
{
    int64_t next_ns = NEVER;
    for (int32_t i = 0; i < s->count; i++) {
        Terminal *t = s->terminals[i];
        if (!t->held_ns)
            continue;
        if (t->held_ns <= now_ns) {
            t->held_ns = 0;
            watch(s, i, EPOLL_CTL_ADD);
        } else if (t->held_ns < next_ns)
            next_ns = t->held_ns;
    }
    return next_ns;
}

/* Step the mechanics, and resume reading slowed hosts. Return the time at which other work than deliveries is due. */
static int64_t work_in_idle_time(Server *s, int64_t now_ns)
{
    int64_t times[4] = {resume(s, now_ns), s->python_ns, NEVER, NEVER}, easy_ns = NEVER;
    if (s->count) {
        Bus *b = s->terminals[0]->bus;
        step_to(b, now_ns);
        times[2] = s->next_step(b->line.mechanics);
    }
    if (s->watched)
        times[3] = now_ns + LONGEST_SLEEP_NS;
    for (int32_t i = 0; i < 4; i++)
        easy_ns = times[i] < easy_ns ? times[i] : easy_ns;
    return easy_ns;
}

/* Serve until Python has something to do, and return what. A task of a line may have changed Python's plans, so it is
 * returned after each, with 0. Python's lock is held, except while nothing is due. */
int32_t line_serve(Server *s)
{
    for (int32_t left = 0; !left;) {
        int64_t now_ns = look_at_clock(s), due_ns = line_find_delivery(s), easy_ns = NEVER;
        for (int32_t i = 0; i < s->count; i++)
            s->terminals[i]->bus->line.done = 0;
        if (s->ledger->most && s->ledger->entries.size && s->python_ns == NEVER)
            s->python_ns = now_ns + s->flush_ns;
        if (due_ns - now_ns > IDLE_NS)
            easy_ns = work_in_idle_time(s, now_ns);
        if (!has_run_task(s)) {
            wait_for_event(s, due_ns, easy_ns);
            serve_event(s);
        }
        left = s->news || s->single || s->looked_ns >= s->python_ns || has_run_task(s);
    }
    int32_t news = s->news;
    s->news = 0;
    for (int32_t i = 0; i < s->count; i++)
        news |= (s->terminals[i]->bus->line.raised ? RAISED : 0) | (changed(s->terminals[i]) ? ADAPTER : 0);
    return news;
}

/* Begin to serve the device that a terminal has now. */
void line_plug(Server *s, int32_t index)
{
    watch(s, index, EPOLL_CTL_DEL); /* fails for a new device */
    if (s->terminals[index]->plugged)
        watch(s, index, EPOLL_CTL_ADD);
}

/* Wake also when a descriptor of Python is readable. */
void line_watch(Server *s, int32_t descriptor)
{
    struct epoll_event event = {.events = EPOLLIN, .data.u64 = OF_PYTHON};
    epoll_ctl(s->waiting, EPOLL_CTL_ADD, descriptor, &event);
}

#endif

/* Return a status packet in `data`, which has room for one of any size, and its size. */
int64_t line_status(int32_t protocol, int32_t id, int32_t error, const uint8_t *parameters, int64_t size, uint8_t *data)
{
    Bytes made = {0};
    append_status(&made, protocol, id, error, parameters, size);
    int64_t count = made.size;
    memcpy(data, made.data, (size_t)count);
    free(made.data);
    return count;
}

/* Forget the entries of a ledger that Python has taken. */
void line_forget(Ledger *ledger) { ledger->entries.size = 0; }

void line_free_ledger(Ledger *ledger) { free(ledger->entries.data); }

/* Return the checksum of this source; compiled_line.py compares it, because it reads the structs from the source. */
uint32_t dxl_source(void) { return SOURCE_CRC; }
