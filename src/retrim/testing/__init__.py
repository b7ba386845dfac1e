"""Conformance suites for plants, tasks, controllers, residual models and vehicle links, for use in any test suite.

Each function raises ``AssertionError``, whose message states the broken law::

    def test_my_plant():
        retrim.testing.check_plant(lambda: MyPlant())
"""

from .controller import check_controller as check_controller
from .plant import check_plant as check_plant
from .residual import check_residual as check_residual
from .task import check_task as check_task
from .vehicle import check_vehicle as check_vehicle
