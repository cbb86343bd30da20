/* Pairing: splits the packets of some buses into exchanges, and finds the replies of each. `compiled_pairing.py`
 * fills the structs.
 *
 * A log can contain any times, so sums of times wrap. Sources: ROBOTIS e-Manual, Protocol 1.0 and Protocol 2.0,
 * instruction and status packets.
 */

#include <stdint.h>
#include <string.h>

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file: compiled_pairing.py rejects an object of another version */
#endif

#define IDS 256
#define BYTES 256 /* values of an error byte */
#define BROADCAST_ID 254
#define BYTE_NS 10000000000 /* wire time of a byte times the rate in bit/s: ten bits a byte */
#define RECENT 16           /* requests with which another one is compared: a robot has few */
#define REST_NS 1000000     /* a longer pause of the line is a rest */
#define HEADER_2 0x00fdffff /* first four bytes of Protocol 2.0; no packet of Protocol 1.0 has length 0 */

enum { INSTRUCTION = 1, STATUS = 2, NOISE = 3, LATE = 4 }; /* packets.py */
enum { PING = 1, READ = 2, SYNC_READ = 0x82, FAST_SYNC_READ = 0x8A, BULK_READ = 0x92, FAST_BULK_READ = 0x9A };
enum { NONE = -1, OWN = 0, BEHIND = 1, LINE = 2 };                  /* exchanges.py: Loss */
enum { NO_KIND = -1, CHAINED, FIRST, RESTED, NEXT };                /* exchanges.py: ReplyKind */

typedef struct {
    const int64_t *rows; /* rows of the packets in the columns, by bus, then by time */
    const int64_t *cycle, *first_ns, *last_ns, *start, *length;
    const uint8_t *bus, *kind, *servo_id, *data;
    int64_t count, bytes; /* of `rows`; of `data` */
} Packets;

typedef struct {
    const int64_t *rates, *delays_ns; /* bit/s, 0 if unknown; return delays */
    int64_t *free_ns;                 /* time at which the line has carried everything that was sent */
    int64_t count;
} Buses;

typedef struct { /* columns of `DistinctRequests` */
    const int64_t *servos, *places, *ids, *begins, *blocks, *block_ends;
    const uint8_t *fast;
    int64_t widest; /* columns of `blocks` and `block_ends` */
} Requests;

typedef struct { /* columns of `Exchanges`, and: */
    int64_t *bus, *cycle, *request, *asked_ns, *blocked_ns, *sent_ns, *last_ns, *noise;
    int64_t *answer, *kind, *extra_ns;
    int64_t *row;      /* row of the instruction; -1 without one */
    int64_t *asked_id; /* ID in the instruction; -1: any servo may answer, or no instruction */
    int64_t count;
} Exchanges;

typedef struct { /* columns of `Replies` */
    int64_t *exchange, *servo, *place, *took_us, *own_ns, *last_ns, *due_ns, *kind;
    uint8_t *answers, *strange;
} Replies;

typedef struct { /* columns of `DueReplies`, and the rows without a reply */
    int64_t *exchange, *servo, *place, *reply, *loss;
    uint8_t *broken;
    int64_t *missing;
} DueReplies;

typedef struct { /* columns of `TrafficCounts` */
    int64_t *packets, *bytes; /* by bus and kind */
    int64_t *instructions, *replies, *protocol, *longest_ns, *errors;
    int64_t kinds;
} TrafficCounts;

uint32_t dxl_source(void)
{
    return SOURCE_CRC;
}

static int64_t plus(int64_t a, int64_t b)
{
    return (int64_t)((uint64_t)a + (uint64_t)b);
}

static int64_t minus(int64_t a, int64_t b)
{
    return (int64_t)((uint64_t)a - (uint64_t)b);
}

static int64_t larger(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

static int64_t wire_ns(const Buses *buses, const Packets *packets, int64_t row)
{
    int64_t rate = buses->rates[packets->bus[row]];
    return rate > 0 ? (int64_t)((uint64_t)packets->length[row] * BYTE_NS / (uint64_t)rate) : 0;
}

/* A byte of a packet; 0 after its end. */
static uint8_t byte_at(const Packets *packets, int64_t row, int64_t at)
{
    return at < packets->length[row] ? packets->data[packets->start[row] + at] : 0;
}

static int is_second(const Packets *packets, int64_t row)
{
    uint32_t head = 0;
    for (int at = 3; at >= 0; at--) {
        head = head << 8 | byte_at(packets, row, at);
    }
    return head == HEADER_2;
}

static int is_same(const Packets *packets, int64_t one, int64_t other)
{
    int64_t length = packets->length[one];
    return length == packets->length[other] &&
           !memcmp(packets->data + packets->start[one], packets->data + packets->start[other], (size_t)length);
}

/* Set request and asked ID of an exchange from its instruction. The request is 0 if no servo is asked, ID + 1 if one
 * is asked. For several it is -1 minus the exchange that first had the same bytes, as far as `recent` has it. */
static void read_instruction(const Packets *packets, const Exchanges *found, int64_t at, int64_t *recent, int64_t *seen)
{
    int64_t row = found->row[at];
    int second = is_second(packets, row);
    int code = byte_at(packets, row, second ? 7 : 4), servo_id = byte_at(packets, row, second ? 4 : 2);
    int several = code == BULK_READ ||
                  (second && (code == SYNC_READ || code == FAST_SYNC_READ || code == FAST_BULK_READ));
    int any = code == PING && packets->servo_id[row] == BROADCAST_ID;
    found->asked_id[at] = any ? -1 : packets->servo_id[row];
    found->request[at] = (code == PING || code == READ) && servo_id != BROADCAST_ID ? servo_id + 1 : 0;
    if (!several) {
        return;
    }
    for (int64_t back = 1; back <= RECENT && back <= *seen; back++) {
        int64_t one = recent[(*seen - back) % RECENT];
        if (is_same(packets, found->row[one], row)) {
            found->request[at] = -1 - one;
            return;
        }
    }
    recent[(*seen)++ % RECENT] = at;
    found->request[at] = -1 - at;
}

/* Split packets into exchanges: one of each bus without an instruction, then one for each instruction. `exchange` gets
 * that of each packet. Return 0, or -1 for packets that are not sorted by bus, not within `data`, or of an unknown kind. */
int64_t pairing_split(const Packets *packets, const Buses *buses, const Exchanges *found, int64_t *exchange,
    const TrafficCounts *counts)
{
    int64_t recent[RECENT], seen = 0, at = -1, bus = -1;
    int64_t free_ns = 0, carried_ns = 0, latest_ns = 0;
    for (int64_t next = 0; next <= packets->count; next++) {
        int64_t row = next < packets->count ? packets->rows[next] : 0;
        int64_t until = next < packets->count ? packets->bus[row] : buses->count - 1;
        if (until < bus || until >= buses->count) {
            return -1;
        }
        while (bus < until) {
            at++, bus++;
            free_ns = buses->free_ns[bus], carried_ns = 0, latest_ns = INT64_MIN;
            found->bus[at] = bus, found->cycle[at] = -1, found->row[at] = -1, found->asked_id[at] = -1;
            found->request[at] = found->asked_ns[at] = found->blocked_ns[at] = found->noise[at] = 0;
            found->sent_ns[at] = free_ns;
        }
        if (next == packets->count) {
            break;
        }
        int64_t length = packets->length[row], start = packets->start[row];
        if (length < 0 || start < 0 || length > packets->bytes || start > packets->bytes - length ||
            packets->kind[row] >= counts->kinds) {
            return -1;
        }
        counts->packets[bus * counts->kinds + packets->kind[row]]++;
        counts->bytes[bus * counts->kinds + packets->kind[row]] += length;
        if (packets->kind[row] == INSTRUCTION) {
            int64_t wire = wire_ns(buses, packets, row), first_ns = packets->first_ns[row];
            at++, counts->instructions[bus * IDS + packets->servo_id[row]]++;
            found->bus[at] = bus, found->cycle[at] = packets->cycle[row], found->row[at] = row;
            found->asked_ns[at] = first_ns, found->noise[at] = 0;
            int64_t took_ns = minus(packets->last_ns[row], first_ns);
            found->blocked_ns[at] = buses->rates[bus] > 0 ? larger(minus(took_ns, wire), 0) : 0;
            /* Transmission begins when the instruction is written and the line is free. */
            latest_ns = larger(latest_ns, minus(first_ns, carried_ns));
            carried_ns = plus(carried_ns, wire);
            buses->free_ns[bus] = found->sent_ns[at] = plus(larger(latest_ns, free_ns), carried_ns);
            read_instruction(packets, found, at, recent, &seen);
        } else if (packets->kind[row] == NOISE) {
            found->noise[at] += length;
        }
        exchange[next] = at;
    }
    return 0;
}

static int is_status(const Packets *packets, int64_t row)
{
    int kind = packets->kind[row];
    return kind == STATUS || (kind == LATE && packets->servo_id[row] != BROADCAST_ID);
}

/* Return the number of intact blocks of a fast status packet, which several servos share, or else -1. */
static int64_t blocks_of(const Packets *packets, const Requests *requests, int64_t request, int64_t row)
{
    int64_t count = 0;
    if (packets->servo_id[row] != BROADCAST_ID || !is_second(packets, row)) {
        return -1;
    }
    const int64_t *ends = requests->block_ends + request * requests->widest;
    while (count < requests->widest && ends[count] <= packets->length[row]) {
        count++;
    }
    return count;
}

/* Return the kind of an exchange's first reply. */
static int64_t first_kind(const Exchanges *exchanges, const Requests *requests, int64_t at)
{
    int64_t request = exchanges->request[at];
    if (requests->fast[request] || requests->servos[request] != 1 || at == 0 ||
        exchanges->cycle[at] != exchanges->cycle[at - 1]) {
        return FIRST;
    }
    return minus(exchanges->asked_ns[at], exchanges->last_ns[at - 1]) > REST_NS ? RESTED : NEXT;
}

/* Return the number of replies in the packets. */
int64_t pairing_count_replies(
    const Packets *packets, const Requests *requests, const Exchanges *exchanges, const int64_t *exchange)
{
    int64_t found = 0;
    for (int64_t next = 0; next < packets->count; next++) {
        int64_t row = packets->rows[next];
        if (is_status(packets, row)) {
            int64_t blocks = blocks_of(packets, requests, exchanges->request[exchange[next]], row);
            found += blocks < 0 ? 1 : blocks;
        }
    }
    return found;
}

/* Fill in the replies, the requested replies, and `last_ns`, `answer`, `kind` and `extra_ns` of the exchanges. Return
 * the number of missing replies. */
int64_t pairing_pair_replies(const Packets *packets, const Buses *buses, const Requests *requests,
    const Exchanges *exchanges, const int64_t *exchange, const Replies *replies, const DueReplies *due,
    const TrafficCounts *counts)
{
    int64_t next = 0, reply = 0, begin = 0, lacking = 0;
    for (int64_t at = 0; at < exchanges->count; at++) {
        int64_t request = exchanges->request[at], bus = exchanges->bus[at], servos = requests->servos[request];
        exchanges->answer[at] = -1, exchanges->kind[at] = first_kind(exchanges, requests, at);
        int64_t due_ns = exchanges->sent_ns[at], before_ns = due_ns, last_ns = due_ns, missing = servos, first = reply;
        for (int64_t place = 0; place < servos; place++) {
            due->exchange[begin + place] = at, due->place[begin + place] = place;
            due->servo[begin + place] = bus * IDS + requests->ids[requests->begins[request] + place];
            due->reply[begin + place] = -1;
        }
        for (; next < packets->count && exchange[next] == at; next++) {
            int64_t row = packets->rows[next];
            if (!is_status(packets, row)) {
                continue;
            }
            int64_t wire = wire_ns(buses, packets, row), blocks = blocks_of(packets, requests, request, row);
            int second = is_second(packets, row), in_time = packets->kind[row] == STATUS;
            /* Each reply of a chain is due its return delay and its wire time after the preceding one. */
            due_ns = plus(due_ns, plus(wire, buses->delays_ns[bus]));
            for (int64_t block = 0; block < (blocks < 0 ? 1 : blocks); block++, reply++) {
                int servo_id = packets->servo_id[row], error = byte_at(packets, row, second ? 8 : 4);
                if (blocks >= 0) {
                    int64_t begins = requests->blocks[request * requests->widest + block];
                    error = byte_at(packets, row, begins), servo_id = byte_at(packets, row, begins + 1);
                }
                int64_t place = requests->places[request * IDS + servo_id], servo = bus * IDS + servo_id;
                replies->exchange[reply] = at, replies->servo[reply] = servo;
                replies->place[reply] = place, replies->took_us[reply] = 0, replies->due_ns[reply] = due_ns;
                replies->last_ns[reply] = packets->last_ns[row];
                replies->own_ns[reply] = minus(minus(packets->last_ns[row], before_ns), wire);
                replies->strange[reply] = place < 0 && in_time && blocks < 0;
                /* The first of several replies of a servo counts. */
                int answers = place >= 0 && in_time && due->reply[begin + place] < 0;
                replies->answers[reply] = (uint8_t)answers;
                counts->replies[servo]++, counts->protocol[servo] = second ? 2 : 1;
                if (error) {
                    counts->errors[servo * BYTES + error]++;
                }
                if (answers) {
                    int64_t took_ns = minus(packets->last_ns[row], exchanges->asked_ns[at]);
                    counts->longest_ns[servo] = larger(counts->longest_ns[servo], took_ns);
                    replies->took_us[reply] = took_ns / 1000 - (took_ns % 1000 < 0);
                    due->reply[begin + place] = exchanges->answer[at] = reply, missing--;
                }
                /* A reply that took less than half its wire time was delivered together with the preceding one. */
                int together = reply > first && replies->own_ns[reply] < -(wire / 2);
                int in_turn = answers && place == reply - first && !requests->fast[request] && !together;
                replies->kind[reply] = !in_turn ? NO_KIND : reply > first ? CHAINED : exchanges->kind[at];
                if (together) {
                    replies->kind[reply - 1] = NO_KIND;
                }
                last_ns = larger(last_ns, packets->last_ns[row]);
            }
            before_ns = packets->last_ns[row];
        }
        exchanges->last_ns[at] = last_ns, exchanges->extra_ns[at] = INT64_MIN;
        if (servos > 0 && missing == 0) {
            int64_t answer = exchanges->answer[at];
            exchanges->extra_ns[at] = minus(replies->last_ns[answer], replies->due_ns[answer]);
        }
        /* Only the first missing reply is the servo's own: the next ones wait for it in vain. */
        int64_t loss = missing == servos && servos > 1 ? LINE : OWN;
        for (int64_t one = begin; one < begin + servos; one++) {
            int lacks = due->reply[one] < 0;
            due->loss[one] = lacks ? loss : NONE;
            due->broken[one] = lacks && loss == OWN && exchanges->noise[at] > 0;
            if (lacks) {
                due->missing[lacking++] = one;
                loss = loss == OWN ? BEHIND : loss;
            }
        }
        begin += servos;
    }
    return lacking;
}
