"""Carry packets between a Crazyradio and UDP, so that `retrim live --plant crazyflie` reaches a real Crazyflie.

It needs Bitcraze's client library (`pip install cflib`, GPL-3), in an environment of its own or in any, and nothing of
retrim: python crazyflie_radio.py radio://0/80/2M/E7E7E7E7E7 [PORT]
"""

import queue
import socket
import sys
import threading

import cflib.crtp
from cflib.crtp.crtpstack import CRTPPacket

NULL = 0xF3  # port 15, channel 3: somebody asks who is there


def main(uri: str, port: int = 19850) -> None:
    """Carry packets until Ctrl-C, or until the radio is lost."""
    cflib.crtp.init_drivers()
    errors: queue.Queue[str] = queue.Queue()
    link = cflib.crtp.get_link_driver(uri, None, errors.put)
    if link is None:
        sys.exit(f"{uri}: no link; expected one like radio://0/80/2M/E7E7E7E7E7, usb://0 or udp://HOST:PORT")
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.bind(("127.0.0.1", port))
    server.settimeout(0.2)
    client = None

    def down() -> None:
        """Carry what comes from the Crazyflie."""
        while True:
            packet = link.receive_packet(0.2)
            if packet is not None and client is not None:
                server.sendto(bytes([packet.header]) + bytes(packet.data), client)

    threading.Thread(target=down, daemon=True).start()
    print(f"{uri} is at udp:127.0.0.1:{port}; Ctrl-C ends it", flush=True)
    try:
        while errors.empty():
            try:
                data, client = server.recvfrom(64)
            except TimeoutError:
                continue
            if data and data[0] & NULL == NULL:
                server.sendto(data, client)
            elif data:
                packet = CRTPPacket(data[0], data[1:])
                link.send_packet(packet)
        sys.exit(f"{uri}: lost: {errors.get()}")
    except KeyboardInterrupt:
        link.close()


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
