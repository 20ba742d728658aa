"""Check this machine for the system libraries that open3d needs: `pnu doctor [--install | --require]`."""

from pnu.runtime.system_libraries import main

if __name__ == "__main__":
    main()
