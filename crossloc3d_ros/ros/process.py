"""The localizer node as a process: signals, logging, and an end in order."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Sequence

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from crossloc3d_ros.config import LocalizerNodeConfig
from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.ros.localizer_node import LocalizerNode, load_localizer

EXIT_ERROR = 2
SPIN_S = 0.1
"""How long the executor waits at most before the process notices a signal."""


class _RosLogHandler(logging.Handler):
    """Show what the libraries of this package log through the node's logger."""

    def __init__(self, node: LocalizerNode) -> None:
        super().__init__()
        self._log = node.get_logger().get_child("library")
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        # A call site of a ROS logger has one severity for good: one line each.
        text = self.format(record)
        if record.levelno >= logging.ERROR:
            self._log.error(text)
        elif record.levelno >= logging.WARNING:
            self._log.warning(text)
        elif record.levelno >= logging.INFO:
            self._log.info(text)
        else:
            self._log.debug(text)


def run_localizer(arguments: Sequence[str], load: Callable[[LocalizerNodeConfig], Localizer] = load_localizer) -> int:
    """Run the node until a signal stops it, and return the exit code; `load` makes its localizer.

    0 after SIGINT or SIGTERM, as ROS 2 launch expects it; 2 where it could not start by itself, which the log
    explains. Raises CrossLocError for arguments and parameters that are wrong.
    """
    # The handlers are ours, so that the worker ends and the node is destroyed while the context is still valid.
    signal.signal(signal.SIGTERM, _interrupt)
    signal.signal(signal.SIGINT, _interrupt)
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # the client library has no common base for malformed arguments
        raise ConfigError(str(error)) from error
    executor = SingleThreadedExecutor()
    node: LocalizerNode | None = None
    handler: logging.Handler | None = None
    code = EXIT_ERROR
    try:
        surplus = remove_ros_args(["localizer", *arguments])[1:]
        if surplus:
            raise ConfigError(f"unknown argument '{surplus[0]}'; parameters follow --ros-args, as -p name:=value")
        node = LocalizerNode(load)
        handler = _RosLogHandler(node)
        logging.getLogger("crossloc3d_ros").addHandler(handler)
        logging.getLogger("crossloc3d_ros").propagate = False
        executor.add_node(node)
        while not node.failure:
            _spin_once(executor, node)
    except KeyboardInterrupt:
        code = 0
    finally:
        if not _shut_down(executor, node, handler):
            # A thread that hangs in compiled code makes the interpreter crash at exit; everything else is shut down.
            os._exit(code)
    return code


def _spin_once(executor: SingleThreadedExecutor, node: LocalizerNode) -> None:
    """Run one callback, if there is one; what it raises costs that message or call, not the node."""
    try:
        executor.spin_once(timeout_sec=SPIN_S)
    except Exception as error:
        if not rclpy.ok():
            raise
        node.get_logger().error(f"a message or call was left unanswered: {type(error).__name__}: {error}")


def _shut_down(executor: SingleThreadedExecutor, node: LocalizerNode | None, handler: logging.Handler | None) -> bool:
    """Shut down node, executor and context; return whether the node's threads have ended."""
    # A second signal would only interrupt the orderly shutdown.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ended = node is None or node.close()
    if handler is not None:
        logging.getLogger("crossloc3d_ros").removeHandler(handler)
    executor.shutdown()
    if node is not None:
        node.destroy_node()
    rclpy.try_shutdown()
    return ended


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt
