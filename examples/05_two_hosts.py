"""Pretrain on several hosts at once: one program, whose starts are divided among all devices of all of them.

On each host, with the address of the first one and the host's own number:

    python examples/09_two_hosts.py 10.0.0.5:9500 2 0        # on 10.0.0.5
    python examples/09_two_hosts.py 10.0.0.5:9500 2 1        # on the other one

Without arguments two processes of this machine stand in for two hosts. The policy is that of one host, to rounding.
"""

import socket
import subprocess
import sys


def train(address: str, hosts: int, number: int, quick: bool = False) -> None:
    """Be one of the hosts."""
    from retrim import Setup, changed, load
    import jax  # isort: skip  (after retrim, which silences the loader of JAX's cache)

    jax.distributed.initialize(address, hosts, number)  # before anything is computed
    small = {"num_updates": 20, "num_envs": 4, "horizon": 30, "hidden_sizes": (8,)} if quick else {"num_envs": 64}
    setup, hosts = Setup.from_preset(changed(load("hover/fast"), pretrain=small)), jax.process_count()
    for policy, losses in setup.pretraining(seed=0):  # noqa: B007
        if number == 0:
            print(f"{jax.device_count()} devices of {hosts} hosts: loss {float(losses[-1]):.6f}", flush=True)
    if number == 0:
        print(f"norm of the first layer {float(abs(policy.layers[0].weight).sum()):.6f}")


def main(quick: bool = False) -> None:
    """Be both of two hosts."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    words = [sys.executable, __file__, address, "2"]
    more = ["quick"] if quick else []
    hosts = [subprocess.Popen([*words, str(i), *more], stdout=subprocess.PIPE, text=True) for i in (0, 1)]
    outputs = [host.communicate()[0] for host in hosts]
    if any(host.returncode for host in hosts):
        raise SystemExit("a host has failed")
    print(outputs[0], end="")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        train(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), quick="quick" in sys.argv)
    else:
        main()
