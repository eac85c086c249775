"""Board agent: carries requests from a serial line to the Chi.Bio server, and is the dead-man switch of the pumps.

One file, Python 3.7 standard library only: it is copied to the BeagleBone as it is (installation: docs/board_agent.md).

Frames (protocol 1, ASCII, one request at a time on the line)
-------------------------------------------------------------
Request, PC to board, one line of at most 512 bytes including the newline:

    >ID METHOD PATH CRC\\n          >17 POST /SetOutputOn/Pump1/0/M0 7b0c9a3e\\n

  ID      decimal, 1 to 4294967295, no sign, no leading zero. 0 is reserved for replies to unreadable requests.
  METHOD  GET or POST (carried to the device), RAW (GET, the answer not reduced), HELLO, PING or BYE (the agent's own).
  PATH    starts with "/", printable ASCII without space and without ">". "/" for HELLO, PING and BYE.
  CRC     8 lower-case hexadecimal digits: zlib.crc32 of the line from ">" up to, not including, the space before CRC.

Reply, board to PC, a header line, LENGTH bytes of body and one newline:

    <ID STATUS LENGTH CRC\\nBODY\\n

  ID      the request's; 0 if the request could not be read.
  STATUS  decimal. 100 to 599: the device's own HTTP status (HELLO, PING, BYE: 200). Under 100: the agent's,
            10  the device refused the connection: the request was not carried out;
            11  the device was reached but no complete answer came: it may have acted;
            12  the answer was longer than 262144 bytes;
            20  unreadable request (CRC, form or length), with ID 0: not carried out, send it again.
  LENGTH  decimal number of body bytes, 0 to 262144.
  CRC     8 lower-case hexadecimal digits: zlib.crc32 of b"<ID STATUS LENGTH" + BODY (no newline, no space before CRC).
  BODY    the device's body; a line of text for status under 100; JSON for HELLO, PING, BYE.

Both sides ignore bytes that belong to no frame: the agent looks for the last ">" of a line, the PC for a line that
starts with "<". Replies of earlier requests may still arrive after a time-out: the PC drops a reply whose ID is not
the one it waits for (ID 0 counts as the answer to the request in flight).

Repeating a request is safe: a request equal to the previous one (same ID, METHOD, PATH) is answered from memory and
not carried out again. So a PC that got no reply, a damaged one or ID 0 sends the very same line again; it takes a new
ID for every new request and starts a session with HELLO and an ID drawn at random, which also clears that memory.

HELLO, PING and BYE answer {"agent": "board_agent", "protocol": 1, "version": "1.0", "deadman_s": 120.0, "silent_s":
0.0, "armed": true, "trips": 0, "last_trip": "", "url": "http://192.168.7.2:5000"}.

GET /getSysdata/ is reduced to the fields that a client needs (under 1 KB): the same JSON with fewer keys; `record`
lists hold their last value only, and "_records" {"time": n, "OD": n, "ThermometerIR": n} holds their lengths, which
differ for an instant while the device appends; "Terminal.text" is cut to its newest 160 characters. RAW gives it whole.

Dead man
--------
Every valid request is a heartbeat. After `--deadman` seconds without one, Pump1 to Pump4 of every present reactor are
switched off, read back, and the pass is repeated until it is verified or a heartbeat comes. A reactor whose on-board
regulation is on (OD.ON = 1) has been handed over deliberately and is left alone. It is armed from the start on;
BYE disarms it (a client that has left everything in order) until the next request that is not BYE.
"""
