from aolink.cli import main

main()
